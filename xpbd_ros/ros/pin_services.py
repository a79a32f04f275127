"""
The services of a scene with pins: ``~/pin/<name>/grasp`` and ``~/release_all``.

Each pin of the scene has a ``grasp``. A pin that is released keeps its pose and follows its
targets, so that it can grasp where it is.
"""

import numpy as np
from std_srvs.srv import SetBool, Trigger

from xpbd_ros.ros.services import answer
from xpbd_ros.sim.commands import Grasp, Release, ReleaseAll


class PinServices:
    """
    The services; each acts on the stepper's thread, between two frames, and answers when done.

    Parameters
    ----------
    node : the ``ClothNode`` that offers them

    """

    def __init__(self, node):
        self._node = node
        self._offered = [node.create_service(Trigger, '~/release_all', self._release_all)]
        for name in node.scene.sections.get('pins', {}):
            def serve(request, response, name=name):
                return answer(node, response,
                              lambda: grasp(node, name) if request.data else release(node, name),
                              '{}')
            self._offered.append(node.create_service(SetBool, f'~/pin/{name}/grasp', serve))

    def close(self) -> None:
        """Destroy the services."""
        for service in self._offered:
            self._node.destroy_service(service)

    def _release_all(self, request, response):
        def release_all():
            self._node.interaction.act()
            count = len(self._node.simulation.effects['pin'].held)
            self._node.interaction.act(ReleaseAll())
            return f'{count} pin{"s" * (count != 1)}'
        return answer(self._node, response, release_all, 'released {}')


def grasp(node, name: str) -> str:
    """Close a pin of the scene at its present pose; return what it holds."""
    node.interaction.act()
    pin = node.simulation.effects['pin']
    if name in pin.held:
        return f'already holds {_held(node, name)}'
    node.interaction.act(Grasp(name, pin.pose(name), node.scene.sections['pins'][name].radius))
    return f'holds {_held(node, name)}'


def release(node, name: str) -> str:
    """Open a pin of the scene; return what it held."""
    node.interaction.act()
    held = node.simulation.effects['pin'].held.get(name)
    node.interaction.act(Release(name))
    return f'released {_particles(len(held.particles))}'


def _held(node, name: str) -> str:
    offsets = node.simulation.effects['pin'].held[name].offsets
    nearest = float(np.linalg.norm(offsets, axis=1).min())
    return f'{_particles(len(offsets))}, the nearest {nearest:.3g} m away'


def _particles(count: int) -> str:
    return f'{count} particle{"s" * (count != 1)}'
