"""Grids of 3GPP New Radio: fields of a scenario from a numerology and a comb of pilots."""

from typing import Any

from rhs_isac_ros.support.fields import Field

_SUBCARRIERS_PER_BLOCK, _SYMBOLS_PER_SLOT = 12, 14
_FIELDS = {
    'numerology': Field(int, low=0, high=6), 'resource_blocks': Field(int, low=1, high=275),
    'symbols': Field(int, low=1, high=4096), 'comb': Field(int, low=1, high=12)}


def nr_grid(numerology: int, resource_blocks: int, symbols: int, comb: int = 1) -> dict[str, Any]:
    """Return the fields of a scenario whose pilots are those of an NR grid.

    A sub-band is one sub-carrier with a pilot, and a frame is one OFDM symbol with the normal
    cyclic prefix, on average over a slot. A comb has a pilot on every `comb`-th sub-carrier, such
    as 2, 4, 6 or 12 for PRS, and 2, 4 or 8 for SRS. Source: 3GPP TS 38.211, sections 4.2, 4.3,
    6.4.1.4 and 7.4.1.7. Raises ValueError if a number is out of range, or the comb does not divide
    the sub-carriers.

    Examples
    --------
    >>> grid = nr_grid(numerology=1, resource_blocks=24, symbols=4, comb=4)
    >>> grid['n_subbands'], grid['subband_width_hz'], grid['subband_spacing_hz']
    (72, 30000.0, 120000.0)
    """
    given = {'numerology': numerology, 'resource_blocks': resource_blocks, 'symbols': symbols,
             'comb': comb}
    for name, value in given.items():
        given[name] = _FIELDS[name].checked(name, value)
    n_subcarriers = _SUBCARRIERS_PER_BLOCK * given['resource_blocks']
    if n_subcarriers % given['comb']:
        raise ValueError(f'comb: {comb}, expected a divisor of {n_subcarriers} sub-carriers')
    width_hz = 15e3 * 2 ** given['numerology']
    return {
        'n_subbands': n_subcarriers // given['comb'], 'subband_width_hz': width_hz,
        'subband_spacing_hz': width_hz * given['comb'] if comb > 1 else 0.0,
        'n_frames': given['symbols'],
        'frame_duration_s': 1e-3 / 2 ** given['numerology'] / _SYMBOLS_PER_SLOT}
