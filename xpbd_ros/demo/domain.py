"""A private ROS domain on loopback, so that the demo cannot reach other robots."""

import os
import random
import socket

from xpbd_ros.errors import InputError

DOMAINS = range(1, 101)
"""domains whose ports are below the ephemeral ports"""


def free_domain() -> int:
    """Return a random domain whose discovery ports are free on this machine (RTPS 9.6.1.1)."""
    for domain in random.sample(DOMAINS, len(DOMAINS)):
        if all(_free(7400 + 250 * domain + offset) for offset in (0, 1, 10, 11)):
            return domain
    raise InputError('all ROS domains from 1 to 100 are in use on this machine')


def _free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(('', port))
        except OSError:
            return False
    return True


def private_environment() -> dict[str, str]:
    """Return environment variables for processes on a private domain, on loopback only."""
    found = {key: value for key, value in os.environ.items()
             if key not in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER',
                            'ROS_NAMESPACE')}
    return {**found, 'ROS_DOMAIN_ID': str(free_domain()),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'PYTHONUNBUFFERED': '1'}
