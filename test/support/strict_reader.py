"""Read logs with rosbags, which refuses any message that does not match its definition."""

from collections import Counter
from pathlib import Path

from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)


def read_strictly(run: Path) -> Counter[str]:
    """Deserialize every message of a log, each to its last byte; return how many of each topic."""
    counts = Counter()
    with AnyReader([run], default_typestore=STORE) as bag:
        for connection, _, raw in bag.messages():
            message = bag.deserialize(raw, connection.msgtype)    # refuses 4 surplus bytes
            assert len(raw) == len(STORE.serialize_cdr(message, connection.msgtype)), connection
            counts[connection.topic] += 1
        assert counts.total() == bag.message_count
    return counts
