"""Quality of service as rosbag2 records it with each topic, for a replay to offer it again."""

from dataclasses import dataclass
import functools

import yaml

# Metadata up to version 8 holds rmw's numbers; from version 9 (Jazzy) on, names.
RELIABILITIES = {1: 'reliable', 2: 'best_effort'}
DURABILITIES = {1: 'transient_local', 2: 'volatile'}
FOREVER = '\n    sec: 9223372036\n    nsec: 854775807'    # rmw's infinite duration


@dataclass(frozen=True)
class Qos:
    """The quality of service that a publisher offers."""

    reliability: str = 'reliable'
    """reliable or best_effort"""
    durability: str = 'volatile'
    """volatile, or transient_local (latched)"""
    depth: int = 5
    """messages kept for a slow subscriber, or for a late one where latched"""

    def __post_init__(self):
        """Check the values; rosbag2 reads no others."""
        assert self.reliability in RELIABILITIES.values(), self.reliability
        assert self.durability in DURABILITIES.values(), self.durability
        assert self.depth > 0, self.depth

    @property
    def latched(self) -> bool:
        """True if a late subscriber receives the last messages (transient local)."""
        return self.durability == 'transient_local'

    def offered_profiles(self) -> str:
        """
        Return the channel's ``offered_qos_profiles``: one profile, in a YAML sequence.

        All keys are required: yaml-cpp fails on a missing one with "bad conversion".
        """
        return (f'- history: keep_last\n'
                f'  depth: {self.depth}\n'
                f'  reliability: {self.reliability}\n'
                f'  durability: {self.durability}\n'
                f'  deadline:{FOREVER}\n'
                f'  lifespan:{FOREVER}\n'
                f'  liveliness: automatic\n'
                f'  liveliness_lease_duration:{FOREVER}\n'
                f'  avoid_ros_namespace_conventions: false')


DEFAULT = Qos(depth=10)    # as ros2 bag play offers where no valid profile was recorded


@functools.cache
def recorded_qos(profiles: str) -> Qos:
    """
    Return the quality of service to offer for recorded ``offered_qos_profiles``.

    As ros2 bag play does, it is that of the publishers if they agree, and reliable and volatile
    if they do not or if none was recorded. An unknown history (depth 0) becomes 10 messages.
    """
    try:
        offers = yaml.safe_load(profiles)
        (reliability, durability), = {
            (RELIABILITIES.get(offer['reliability'], offer['reliability']),
             DURABILITIES.get(offer['durability'], offer['durability'])) for offer in offers}
        return Qos(reliability, durability, max(offer['depth'] for offer in offers)
                   or DEFAULT.depth)
    except (yaml.YAMLError, LookupError, TypeError, ValueError, AssertionError):
        return DEFAULT
