"""Positions in several frames."""

from rhs_isac_ros.support.frame_watch import WINDOW_S, FrameWatch


def test_positions_in_the_frame_of_the_node_are_right():
    watch = FrameWatch('map')
    watch.add('/ground_truth', 'map', 0.0)
    assert watch.update(0.0) == ''


def test_a_message_without_a_frame_says_nothing():
    watch = FrameWatch('map')
    watch.add('/ground_truth', '', 0.0)
    assert watch.update(0.0) == ''


def test_another_frame_is_reported_with_its_topic_until_it_has_gone():
    watch = FrameWatch('map')
    watch.add('/ground_truth', 'odom', 5.0)
    assert "'map' (this node), 'odom' (/ground_truth)" in watch.update(5.0)
    assert watch.update(5.0 + WINDOW_S) == ''


def test_a_node_without_a_frame_compares_those_of_messages():
    watch = FrameWatch()
    watch.add('/ground_truth', 'odom', 0.0)
    assert watch.update(1.0) == ''
    watch.add('/position_estimate', 'map', 1.0)
    assert "'map' (/position_estimate), 'odom' (/ground_truth)" in watch.update(1.0)


def test_the_number_of_frames_is_limited():
    watch = FrameWatch('map')
    for number in range(1000):
        watch.add('/ground_truth', 300 * f'{number:03d}', 0.0)
    assert len(watch.update(0.0)) < 2000
