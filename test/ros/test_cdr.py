"""A serialized message ends with its last field."""

import random

from rcl_interfaces.msg import ParameterEvent
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState, PointCloud2
from visualization_msgs.msg import Marker, MarkerArray

from support.strict_reader import STORE
from xpbd_ros.ros.cdr import trimmed
from xpbd_ros.ros.recorder import type_name


def check(message) -> int:
    """Compare with another implementation of CDR; return how many bytes were cut off."""
    kind = type(message)
    raw = serialize_message(message)
    data = trimmed(raw, kind)
    assert raw.startswith(data)
    again = STORE.deserialize_cdr(data, type_name(kind))
    assert len(STORE.serialize_cdr(again, type_name(kind))) == len(data)
    assert deserialize_message(data, kind) == message
    return len(raw) - len(data)


def test_parameter_events_of_any_content_end_where_they_end():
    some = random.Random(1)
    values = (7, 2.5, True, 'text', [1.0, 2.0], [3], [True] * 3, ['a', 'bcd'])

    def parameters() -> list:
        return [Parameter('p' * some.randrange(1, 9), value=some.choice(values)).to_parameter_msg()
                for _ in range(some.randrange(4))]

    cut = [check(ParameterEvent(node='c' * some.randrange(9), new_parameters=parameters(),
                                changed_parameters=parameters(), deleted_parameters=parameters()))
           for _ in range(300)]
    assert max(cut) > 3, 'there was something to cut off'


def test_empty_sequences_of_any_type_end_where_they_end():
    assert check(JointState(name=['a'])) > 0
    assert check(JointState(name=['a'], position=[1.0], velocity=[2.0], effort=[3.0])) == 0
    check(PointCloud2())
    check(MarkerArray(markers=[Marker(ns='ab'), Marker(text='abc')]))
