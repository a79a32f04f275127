"""Quality of service as rosbag2 keeps it with each topic, so that a replay can offer it again."""

from dataclasses import dataclass
import functools

import yaml

# rosbag2 up to version 8 wrote the numbers of rmw, from version 9 (Jazzy) on their names
RELIABILITIES = {1: 'reliable', 2: 'best_effort'}
DURABILITIES = {1: 'transient_local', 2: 'volatile'}
FOREVER = '\n    sec: 9223372036\n    nsec: 854775807'    # rmw's word for no limit


@dataclass(frozen=True)
class Qos:
    """What a publisher offers."""

    reliability: str = 'reliable'
    """reliable or best_effort"""
    durability: str = 'volatile'
    """volatile, or transient_local (latched)"""
    depth: int = 5
    """messages kept for a slow subscriber, or for a late one where latched"""

    def __post_init__(self):
        """Refuse what rosbag2 could not read back."""
        assert self.reliability in RELIABILITIES.values(), self.reliability
        assert self.durability in DURABILITIES.values(), self.durability
        assert self.depth > 0, self.depth

    @property
    def latched(self) -> bool:
        """Whether a late subscriber gets the last messages."""
        return self.durability == 'transient_local'

    def offered_profiles(self) -> str:
        """
        Return the channel's ``offered_qos_profiles``: one profile, in a YAML sequence.

        Every key has to be there: yaml-cpp fails on the lack of one with "bad conversion".
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


DEFAULT = Qos(depth=10)    # what ros2 bag play offers where nothing usable was recorded


@functools.cache
def recorded_qos(profiles: str) -> Qos:
    """
    Return what to offer for recorded ``offered_qos_profiles``, as ros2 bag play decides it.

    That is what the publishers offered if they agree, and reliable and volatile if they do not,
    or if nothing was recorded. A history that DDS did not tell (depth 0) becomes 10 messages.
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
