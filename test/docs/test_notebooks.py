"""The results of the notebooks agree with their text."""

import re

import pytest

pytest.importorskip('myst_nb', reason='MyST-NB is not installed')
pytest.importorskip('rclpy', reason='the pages of the interfaces need ROS')


def numbers(pattern, text):
    """Groups of the only match of a pattern, as numbers."""
    (found,) = re.findall(pattern, text)
    return [float(group) for group in ([found] if isinstance(found, str) else found)]


def test_the_first_fix_is_between_its_bounds_and_its_modes_are_ambiguities(printed):
    text = printed('first_fix')
    distances = [float(number) for number in re.findall(r', (\S+) m from the user', text)]
    assert len(distances) >= 3
    for distance in distances:
        # Multiples of the range at which two bands 0.5 GHz apart repeat.
        assert abs(distance / 0.6 - round(distance / 0.6)) < 0.35
    error, margin = numbers(r'mean squared error +(\S+) ± (\S+) m²', text)
    bound, bound_margin = numbers(r'global bound +(\S+) ± (\S+) m²', text)
    local, _ = numbers(r'Cramér-Rao bound +(\S+) ± (\S+) m²', text)
    assert error > 5 * local
    assert abs(error - bound) < 2 * (margin + bound_margin)
    assert abs(numbers(r'loss due to the position error (\S+) %', text)[0]) < 5


def test_the_band_plan_has_the_smallest_error(printed):
    rows = {name: (float(error), float(margin), float(bound)) for name, error, margin, bound in
            re.findall(r'^(\w+(?: \w+)?) +mean squared error (\S+) ± (\S+) m².* (\S+) m²$',
                       printed('own_codebook'), re.MULTILINE)}
    assert rows.keys() == {'random', 'crlb', 'error', 'four bands'}
    assert rows['crlb'][2] < rows['random'][2] / 2
    assert rows['crlb'][0] > 0.6 * rows['random'][0]
    assert rows['four bands'][0] < 0.75 * rows['error'][0] < rows['crlb'][0]


def test_the_calibration_restores_the_fixes_of_all_users(printed):
    text = printed('calibration')
    (failed,) = re.findall(r'^failed elements: (.*)$', text, re.MULTILINE)
    assert f'failed elements found: {failed}\n' in text
    assert 'before: 0 of 200 users with a fix' in text
    assert 'deviates\n' in text
    assert 'after: 200 of 200 users with a fix' in text
    (after,) = re.findall(r'after.*as expected\n +mean squared error (\S+) ±.*m², (\S+) %', text)
    (ideal,) = set(re.findall(r'ideal.*\n +mean squared error (\S+) ±.*m², \S+ %', text))
    assert float(ideal) <= float(after[0]) < 2 * float(ideal)
    assert float(after[1]) > 85


def test_a_second_surface_reduces_the_error_and_its_pose_is_found(printed):
    text = printed('second_surface')
    alone = numbers(r'one surface: root mean square of the error (\S+) m', text)[0]**2
    errors = [float(value) for value in re.findall(r'°: mean squared error (\S+) ±', text)]
    assert max(errors) < alone
    assert max(errors[-2:]) < min(errors[:2])
    before = numbers(r'entered: off by (\S+) m and (\S+)°; error of the users (\S+) m', text)
    after = numbers(r'estimated: off by (\S+) m and (\S+)°; error of the users (\S+) m', text)
    assert all(2 * better < worse for better, worse in zip(after, before, strict=True))


def test_the_codebook_of_a_board_is_the_better_one_and_pilots_name_the_board(printed):
    text = printed('boards')
    bounds = {name: float(bound) for name, bound in re.findall(
        r"^(\w+ +(?:own|paper's) codebook) +average CRLB (\S+) m²", text, re.MULTILINE)}
    assert len(bounds) == 5
    for board in ('resonant', 'coupled '):
        assert bounds[f"{board}  own codebook"] < 0.9 * bounds[f"{board}  paper's codebook"]
    assert numbers(r'of 50 users with a fix, mean squared error (\S+) m²', text)[0] > 10
    evidence = dict(re.findall(r'^(\w+) +log evidence (\S+)$', text, re.MULTILINE))
    assert evidence.pop('coupled') == '0'
    assert max(map(float, evidence.values())) < -1000
