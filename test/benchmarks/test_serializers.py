"""The libraries that the benchmark of a cycle compares with the codec of the network."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.presences import Presence
from rhs_isac_ros.ros import convert

PARTS = Path(__file__).parents[2] / 'scripts' / 'benchmarks' / 'parts'
SPEC = importlib.util.spec_from_file_location('serializers', PARTS / 'serializers.py')
serializers = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(serializers)
COMPLEX = np.array([[1 + 2j, 3.0], [-1j, 0.5]])
MESSAGES = (
    m.Ack(cycle_id=2**63, user=7),
    m.Data(cycle_id=1, user=1, direction=m.Direction.UPLINK, stage=m.Stage.DELIVERED,
           duration_s=0.5, bits=1e9),
    m.FeedSignals(cycle_id=1, user=1, band=1, signals=COMPLEX),
    m.RhsConfiguration(cycle_id=1, mode=m.Mode.TRANSMISSION, band=0, codebook_id='ab',
                       analog=np.array([[0.25, 1.0, 0.5]])),
    m.PositionEstimate(cycle_id=1, user=1, codebook_id='', position=np.array([2.0, -1.0, 0.5]),
                       covariance_m2=np.diag([1.0, 2.0, 3.0]), crlb_m2=0.1, estimator='bayes',
                       latency_s=0.01),
    m.GroundTruths(cycle_id=0, users=np.array([1, 2]), position=np.ones((2, 3)),
                   velocity=np.zeros((2, 3))),
    Presence(3, 'scenario', 'bs', '/bs', '{}', True))


@pytest.fixture(params=sorted(serializers.SERIALIZERS))
def serializer(request):
    return serializers.SERIALIZERS[request.param]()


@pytest.mark.parametrize('message', MESSAGES, ids=lambda message: type(message).__name__)
def test_a_library_and_the_codec_read_each_other(serializer, message):
    kind, stamp_ns = type(message), 12 * 10**9 + 345
    expected = dataclasses.replace(message, sender=7, scenario_id='s', **(
        {'stamp_ns': stamp_ns} if isinstance(message, m.Message) else {}))
    for found in (
            serializer.from_bytes(kind, convert.to_bytes(message, stamp_ns, (7, 's'))),
            convert.from_bytes(kind, serializer.to_bytes(message, stamp_ns, (7, 's')))):
        assert m.same(found, expected) if isinstance(found, m.Message) else found == expected


def test_bytes_that_are_no_message_are_an_error(serializer):
    with pytest.raises(m.MessageError, match='^Ack: '):
        serializer.from_bytes(m.Ack, b'\0\1\0\0\1')
