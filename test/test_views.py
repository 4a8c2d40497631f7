"""The layouts of RViz and Foxglove match the topics of the nodes."""

import json
from pathlib import Path

import pytest
import yaml

pytest.importorskip('rclpy')
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Path as PathMessage  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from rhs_isac_ros.positioning import Site  # noqa: E402
from rhs_isac_ros.ros import topics  # noqa: E402
from rhs_isac_ros.ros.endpoints import EXCHANGE  # noqa: E402
from rhs_isac_ros.ros.recording import recorded_topics, type_name  # noqa: E402

CONFIG = Path(__file__).parents[1] / 'config'
SURFACES = tuple(Site.from_yaml(CONFIG / 'site.yaml').surfaces)
# Message type of each display of RViz.
DISPLAY_TYPES = {
    'rviz_default_plugins/MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'rviz_default_plugins/Path': 'nav_msgs/msg/Path',
    'rviz_default_plugins/PoseWithCovariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}
USERS = range(1, 5)
# Class and quality of service by topic.
PUBLISHED = {name.lstrip('/'): entry for name, entry in (
    recorded_topics() | {topics.MARKERS: (MarkerArray, EXCHANGE)} | {
        name.format(user=user): (kind, EXCHANGE)
        for name, kind in ((topics.PATH, PathMessage), (topics.TRUE_PATH, PathMessage),
                           (topics.POSE, PoseWithCovarianceStamped))
        for user in USERS}).items()}
# The topics of fusion.
OF_SITE = {topics.POSITION, topics.DIAGNOSTICS.lstrip('/'),
           *(topics.POSE.format(user=user) for user in USERS)}


def rviz(name):
    text = (CONFIG / 'rviz' / f'{name}.rviz').read_text(encoding='utf-8')
    return [display for display in yaml.safe_load(text)['Visualization Manager']['Displays']
            if 'Topic' in display]


def foxglove(name):
    return json.loads((CONFIG / f'{name}.json').read_text(encoding='utf-8'))['configById']


def published(name, is_site):
    """Class and quality of service of a topic, which in a site may be that of a surface."""
    first, _, rest = name.partition('/')
    if is_site and first in SURFACES:
        return PUBLISHED[rest]
    assert not is_site or name in OF_SITE
    return PUBLISHED[name]


def value_of(message, field):
    """Return the value of a field, such as ``pose.covariance[0]``, of an empty message."""
    for part in field.split('.'):
        name, _, index = part.rstrip(']').partition('[')
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message


@pytest.mark.parametrize(('name', 'is_site'), [('network', False), ('site', True)])
def test_rviz_shows_topics_with_their_types_and_quality_of_service(name, is_site):
    displays = rviz(name)
    for display in displays:
        topic = display['Topic']
        kind, profile = published(topic['Value'], is_site)
        assert DISPLAY_TYPES[display['Class']] == type_name(kind)
        assert topic['Durability Policy'].lower() == profile.durability.short_key
        assert topic['Reliability Policy'].lower() == profile.reliability.short_key
        assert topic['History Policy'] == 'Keep Last'
    assert len({display['Topic']['Value'] for display in displays}) == len(displays) == 10
    assert {display['Class'] for display in displays} == set(DISPLAY_TYPES)


def test_rviz_shows_the_same_markers_of_every_surface():
    (of_network,) = [one for one in rviz('network') if one['Class'].endswith('/MarkerArray')]
    of_site = [one for one in rviz('site') if one['Class'].endswith('/MarkerArray')]
    assert [one['Topic']['Value'] for one in of_site] == [
        f'{name}/{topics.MARKERS}' for name in SURFACES]
    assert all(one['Namespaces'] == of_network['Namespaces'] for one in of_site)


@pytest.mark.parametrize(('name', 'is_site', 'topics_of_plots'), [
    ('foxglove', False, {'/capacity', '/protocol_state', '/diagnostics'}),
    ('foxglove_site', True, {'/position', *(f'/{one}/position' for one in SURFACES),
                             '/front/protocol_state', '/diagnostics'})])
def test_foxglove_shows_existing_topics_and_fields(name, is_site, topics_of_plots):
    panels = foxglove(name)
    in_3d = {type_name(published(topic[1:], is_site)[0]) for topic in panels['3D!scene']['topics']}
    assert in_3d == set(DISPLAY_TYPES.values())
    shown = [path['value'] for panel in panels.values() for path in panel.get('paths', ())]
    shown.append(panels['DiagnosticSummary!nodes']['topicToRender'])
    assert {value.partition('.')[0] for value in shown} == topics_of_plots
    for topic, _, field in (value.partition('.') for value in shown):
        kind, _ = published(topic[1:], is_site)
        assert not field or isinstance(value_of(kind(), field), int | float | str)
