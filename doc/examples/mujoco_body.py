"""
A MuJoCo body and a cloth that move one another, frame by frame: pose in, wrench back.

A capsule falls into a sheet that is held at its corners, and bounces and rolls in it. Run it with
``python doc/examples/mujoco_body.py``; it needs the extra ``mujoco``. doc/coupling.md says how it
works.
"""

import mujoco

import xpbd_ros
from xpbd_ros import MoveCollider, Pose

RADIUS, LENGTH, MASS = 0.05, 0.16, 0.3
"""of the capsule [m, m, kg]; the length is between the centres of its ends"""
RATE = 960.0
"""frames per second: how often the two exchange pose and wrench"""
STEPS = 1
"""of MuJoCo, per frame"""
G = 9.80665
BODY = f"""
<mujoco>
  <option gravity="0 0 -{G}" timestep="{1.0 / (RATE * STEPS)}" integrator="implicitfast"/>
  <worldbody>
    <body name="body" pos="0.06 0 0.25" quat="0.5 0.5 -0.5 0.5">
      <freejoint/>
      <geom type="capsule" size="{RADIUS} {0.5 * LENGTH}" mass="{MASS}"/>
    </body>
  </worldbody>
</mujoco>
"""
CORNERS = ('00', '01', '10', '11')
SCENE = {
    'gravity': [0.0, 0.0, -G],
    'frame_rate': RATE,
    'cloths': {'sheet': {
        'grid': {'size': [0.8, 0.8], 'resolution': [41, 41]}, 'density': 0.2,
        'pose': {'position': [-0.4, -0.4, 0.0]}, 'friction': 0.5,
        'effects': {'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'shear': {'stiffness': 100.0},
                    'bend': {'stiffness': 2e-5}}}},
    'pins': {f'corner_{name}': {'cloth': 'sheet', 'at': f'corner_{name}'} for name in CORNERS},
    'colliders': {'body': {'capsule': {'radius': RADIUS, 'length': LENGTH}, 'friction': 0.5,
                           'position': [0.06, 0.0, 0.25],
                           'orientation': [0.5, -0.5, 0.5, 0.5]}},
    'effects': {'contact': {'thickness': 0.004}, 'friction': {}},
}


class Coupled:
    """
    A cloth and a body that move one another; ``overrides`` are keys of the scene.

    ``cloth`` is the simulation of the cloth, ``body`` the view of the body in MuJoCo's data.
    """

    def __init__(self, **overrides):
        self.cloth = xpbd_ros.load(SCENE, **overrides)
        self.model = mujoco.MjModel.from_xml_string(BODY)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.body = self.data.body('body')

    def pose(self) -> Pose:
        """Return the pose of the body."""
        w, x, y, z = self.body.xquat
        return Pose(tuple(self.body.xpos), (x, y, z, w))

    def step(self) -> xpbd_ros.Frame:
        """Move the body with the wrench of the last frame, then the cloth with the body."""
        for _ in range(STEPS):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)    # the pose of the last step
        frame = self.cloth.step([MoveCollider('body', self.pose())])
        state = frame.colliders['body']
        self.body.xfrc_applied[:3] = state.force
        self.body.xfrc_applied[3:] = state.torque
        return frame


def main() -> None:
    """Print where the body is, and what carries it."""
    both = Coupled()
    for _ in range(round(4.0 * RATE)):
        frame = both.step()
        if frame.index % int(RATE / 4) == 0:
            state = frame.colliders['body']
            print(f'{frame.time_ns * 1e-9:5.2f} s   height {state.pose.position[2]:6.3f} m   '
                  f'force of the cloth on the body {state.force[2]:7.3f} N, on the pins '
                  f'{sum(pin.force[2] for pin in frame.pins.values()):7.3f} N')


if __name__ == '__main__':
    main()
