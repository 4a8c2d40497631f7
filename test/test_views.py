"""The configurations of RViz and Foxglove show what the nodes publish."""

import json
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
RVIZ, FOXGLOVE = 'config/rviz/network.rviz', 'config/foxglove.json'
# What each display of RViz takes.
TAKES = {
    'rviz_default_plugins/MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'rviz_default_plugins/Path': 'nav_msgs/msg/Path',
    'rviz_default_plugins/PoseWithCovariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
}


@pytest.fixture(scope='module')
def published():
    """Function that returns the type of a topic and its quality of service, as told by ROS."""
    pytest.importorskip('rclpy')
    from nav_msgs.msg import Path as Way
    from visualization_msgs.msg import MarkerArray

    from rhs_isac_ros.ros import qos, topics
    from rhs_isac_ros.ros.recording import recorded_topics, type_name
    known = recorded_topics() | {topics.MARKERS: (MarkerArray, qos.EXCHANGE)}
    for name in (topics.PATH, topics.TRUE_PATH):
        known |= {name.format(user=user): (Way, qos.EXCHANGE) for user in range(1, 5)}
    return lambda name: (known[name][0], type_name(known[name][0]), known[name][1])


@pytest.fixture(scope='module')
def rviz():
    return yaml.safe_load((ROOT / RVIZ).read_text(encoding='utf-8'))['Visualization Manager']


def test_rviz_shows_topics_with_their_types_and_quality_of_service(rviz, published):
    displays = [display for display in rviz['Displays'] if 'Topic' in display]
    for display in displays:
        topic = display['Topic']
        _, kind, profile = published(topic['Value'])
        assert TAKES[display['Class']] == kind
        assert topic['Durability Policy'].lower() == profile.durability.short_key
        assert topic['Reliability Policy'].lower() == profile.reliability.short_key
        assert topic['History Policy'] == 'Keep Last'
    assert len({display['Topic']['Value'] for display in displays}) == len(displays) == 10
    assert {display['Class'] for display in displays} == set(TAKES)
    assert len({display['Name'] for display in rviz['Displays']}) == len(rviz['Displays'])


def test_both_look_at_the_frame_of_all_positions(rviz):
    topics = pytest.importorskip('rhs_isac_ros.ros.topics')
    assert rviz['Global Options']['Fixed Frame'] == topics.MAP_FRAME
    layout = json.loads((ROOT / FOXGLOVE).read_text(encoding='utf-8'))
    assert layout['configById']['3D!scene']['followTf'] == topics.MAP_FRAME


def test_rviz_names_the_markers(rviz):
    """Each namespace can be switched off."""
    pytest.importorskip('rclpy')
    from rhs_isac_ros.ros import markers
    (display,) = [one for one in rviz['Displays'] if one['Class'].endswith('/MarkerArray')]
    source = Path(markers.__file__).read_text(encoding='utf-8')
    assert set(display['Namespaces']) == set(re.findall(r"_marker\('(\w+)'", source))


def names_in(layout):
    """Topics of the panels, with the fields that they show."""
    panels = layout['configById']
    for name in panels['3D!scene']['topics']:
        yield name, ''
    yield panels['DiagnosticSummary!nodes']['topicToRender'], ''
    for panel in panels.values():
        for path in panel.get('paths', ()):
            name, _, field = path['value'].partition('.')
            yield name, field


def test_foxglove_shows_topics_and_fields_that_there_are(published):
    layout = json.loads((ROOT / FOXGLOVE).read_text(encoding='utf-8'))
    found = dict(names_in(layout))
    assert {'/markers', '/position', '/capacity', '/protocol_state', '/diagnostics'} <= set(found)
    shown_in_3d = {published(name[1:])[1] for name in layout['configById']['3D!scene']['topics']}
    assert shown_in_3d == set(TAKES.values())
    for name, field in names_in(layout):
        kind, _, _ = published(name[1:])
        assert not field or field in kind.get_fields_and_field_types()


def test_every_panel_of_foxglove_has_a_place():
    layout = json.loads((ROOT / FOXGLOVE).read_text(encoding='utf-8'))

    def places(node):
        return [node] if isinstance(node, str) else [*places(node['first']),
                                                     *places(node['second'])]
    assert sorted(places(layout['layout'])) == sorted(layout['configById'])


def test_they_are_installed():
    packages = pytest.importorskip('ament_index_python.packages')
    share = Path(packages.get_package_share_directory('rhs_isac_ros'))
    for name in (RVIZ, FOXGLOVE):
        assert (share / name).read_text(encoding='utf-8') == (ROOT / name).read_text(
            encoding='utf-8')
