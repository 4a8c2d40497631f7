"""A radio with a transceiver AD936x of Analog Devices, one clock for transmitter and receiver.

The transmitter plays the role of the user: it repeats one pilot without a pause. A buffer of the
receiver is as long as several pilots. As long as no samples are lost, the pilot therefore begins
at the same sample of each buffer, as one timing for a cycle requires.
"""

import numpy as np

from rhs_isac_ros.frontend import Waveform

# Largest sample of the converters.
FULL_SCALE = 2**14
N_PILOTS = 4


class AdiRadio:
    """The radio.

    `scale` converts samples to the unit of the model, sqrt(W), at the gain `gain_db`: measure it
    with a known signal. The first `n_stale` buffers after a call may be older than the call.
    """

    waits = True
    # One clock drives transmitter and receiver.
    time_s = 0.0

    def __init__(self, scenario, air, *, uri='ip:192.168.2.1', gain_db=40, scale=1.0, n_stale=5):
        if scenario.n_feeds > 2:
            raise ValueError(f'n_feeds: {scenario.n_feeds}, expected 1 or 2 receivers')
        self.modem = Waveform(scenario)
        self._frequencies_hz, self._n_feeds = scenario.center_frequencies_hz, scenario.n_feeds
        self._uri, self._gain_db, self._scale, self._n_stale = uri, gain_db, scale, n_stale
        self._device, self._sent = None, None

    def capture(self, band, pilot):
        """Return a buffer of each receiver, in which the pilot is complete at least once."""
        if self._device is None:
            self._device, self._sent = self._open(pilot), pilot
        device, frequency_hz = self._device, int(self._frequencies_hz[band])
        if device.rx_lo != frequency_hz:
            device.rx_lo = device.tx_lo = frequency_hz
        for _ in range(self._n_stale):
            device.rx()
        # The pilots of all frames have the same shape, so a factor takes the place of another one.
        factor = np.vdot(self._sent, pilot) / np.vdot(self._sent, self._sent)
        return self._scale * factor * np.atleast_2d(device.rx())

    def close(self):
        """Release the transceiver."""
        if self._device is not None:
            self._device.tx_destroy_buffer()
            self._device.rx_destroy_buffer()
        self._device, self._sent = None, None

    def _open(self, pilot):
        # Only here, so that the package can be installed without the radio.
        import adi

        device = adi.ad9361(self._uri)
        device.sample_rate = int(self.modem.sample_rate_hz)
        device.rx_enabled_channels = list(range(self._n_feeds))
        device.tx_enabled_channels = [0]
        device.tx_cyclic_buffer = True
        device.rx_buffer_size = N_PILOTS * len(pilot)
        for channel in range(self._n_feeds):
            setattr(device, f'gain_control_mode_chan{channel}', 'manual')
            setattr(device, f'rx_hardwaregain_chan{channel}', self._gain_db)
        device.tx(pilot / np.abs(pilot).max() * FULL_SCALE)
        return device
