"""The page on reliability lists the beginnings of all reasons why there is no position."""

import re
from pathlib import Path

from rhs_isac_ros.positioning import diagnosis, movement
from rhs_isac_ros.positioning.alternatives import ALTERNATIVES

PAGE = Path(__file__).parents[2] / 'docs' / 'reliability.rst'


def test_the_page_lists_the_beginning_of_each_reason():
    _, section = PAGE.read_text(encoding='utf-8').split('Positions to trust\n')
    section, _ = section.split('.. _deviating-signals:')
    velocities = re.findall(r"f'(\w+): ", Path(movement.__file__).read_text(encoding='utf-8'))
    assert set(re.findall(r'\* - ``(.*)``', section)) == {
        diagnosis._ENERGY, diagnosis._RESIDUAL, *(kind.reason for kind in ALTERNATIVES),
        *velocities, 'position'}
