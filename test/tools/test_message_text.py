"""Messages as text, against what ``ros2 topic echo`` prints."""

import array

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import Point, Point32, PolygonStamped
from std_msgs.msg import Header, MultiArrayDimension, MultiArrayLayout

import rhs_isac_msgs.msg as ros
from rhs_isac_ros.tools.topic import Layout, as_csv, as_yaml

ARRAY = ros.RealArray(shape=array.array('I', [2, 2]), data=array.array('d', [1.0, -2.5, 0.0, 4.0]))


def test_fields_keep_their_order_and_arrays_are_block_sequences():
    assert as_yaml(ARRAY, Layout()) == (
        'shape:\n- 2\n- 2\ndata:\n- 1.0\n- -2.5\n- 0.0\n- 4.0\n')


def test_nested_messages_and_empty_arrays():
    message = ros.Codebook(header=Header(frame_id='map'), codebook_id='cb')
    assert as_yaml(message, Layout()) == (
        "header:\n  stamp:\n    sec: 0\n    nanosec: 0\n  frame_id: map\nsender: 0\n"
        "scenario_id: ''\ncodebook_id: cb\n"
        "analog:\n  shape: []\n  data: []\ndigital:\n  shape: []\n  re: []\n  im: []\n"
        "average_crlb_m2: 0.0\n")


def test_long_arrays_and_strings_are_truncated():
    assert yaml.safe_load(as_yaml(ARRAY, Layout(max_length=2))) == {
        'shape': [2, 2], 'data': [1.0, -2.5, '...']}
    assert as_yaml(Header(frame_id='somewhere'), Layout(max_length=4)).endswith(
        'frame_id: some...\n')


@pytest.mark.parametrize('message, field, text', [
    (ARRAY, 'data', '<sequence type: double, length: 4>'),
    (ros.PositionEstimate(), 'covariance_m2', '<array type: double[9]>'),
    (MultiArrayLayout(dim=[MultiArrayDimension()]), 'dim',
     '<sequence type: std_msgs/msg/MultiArrayDimension, length: 1>'),
])
def test_arrays_may_be_summarized(message, field, text):
    assert yaml.safe_load(as_yaml(message, Layout(arrays=False)))[field] == text


def test_strings_may_be_summarized():
    text = as_yaml(Header(frame_id='map'), Layout(strings=False))
    assert "frame_id: '<string length: <3>>'" in text


def test_flow_style_is_one_line():
    assert as_yaml(Point(x=1.0), Layout(flow=True)) == '{x: 1.0, y: 0.0, z: 0.0}\n'


def test_arrays_of_numpy_and_of_messages_are_lists():
    message = ros.PositionEstimate(covariance_m2=np.arange(9.0))
    content = yaml.safe_load(as_yaml(message, Layout()))
    assert content['covariance_m2'] == list(map(float, range(9)))
    polygon = PolygonStamped()
    polygon.polygon.points = [Point32(x=1.0), Point32(y=2.0)]
    assert yaml.safe_load(as_yaml(polygon, Layout()))['polygon']['points'] == [
        {'x': 1.0, 'y': 0.0, 'z': 0.0}, {'x': 0.0, 'y': 2.0, 'z': 0.0}]


def test_csv_has_every_leaf_and_an_empty_column_for_an_empty_array():
    assert as_csv(ARRAY, Layout()) == '2,2,1.0,-2.5,0.0,4.0'
    assert as_csv(ARRAY, Layout(max_length=3)) == '2,2,1.0,-2.5,0.0,...'
    assert as_csv(ros.RealArray(data=array.array('d', [1.0])), Layout()) == ',1.0'
