"""A private ROS domain on loopback, so that the demo cannot reach other robots."""

import os
from pathlib import Path
import random
import socket

from xpbd_ros.errors import InputError

DOMAINS = range(1, 101)
"""domains whose ports are below the ephemeral ports"""
PROFILE = Path(__file__).with_name('loopback.xml')
"""Fast DDS profile: sockets on 127.0.0.1 only"""
FAST_DDS = 'rmw_fastrtps_cpp', 'rmw_fastrtps_dynamic_cpp'


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


def loopback() -> dict[str, str]:
    """
    Return environment variables that keep DDS on loopback.

    Under Fast DDS no socket is bound to another interface. Other implementations are asked to
    discover local processes only.
    """
    if os.environ.get('RMW_IMPLEMENTATION') in (None, '', *FAST_DDS):
        return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
                'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE),
                'FASTDDS_DEFAULT_PROFILES_FILE': str(PROFILE)}    # from Fast DDS 3 on
    return {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def private_environment() -> dict[str, str]:
    """Return environment variables for processes on a private domain, on loopback only."""
    found = {key: value for key, value in os.environ.items()
             if key not in ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER',
                            'ROS_NAMESPACE')}
    return {**found, **loopback(), 'ROS_DOMAIN_ID': str(free_domain()), 'PYTHONUNBUFFERED': '1'}
