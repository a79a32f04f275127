"""Contact by lanes: the candidates of brute force, and the bits of one particle at a time."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from support.meshes import box_surface
from support.tiers import slow
from xpbd_ros.effects.friction import Friction, resist, resist_candidate
from xpbd_ros.sim.backend.device_team import DeviceTeam
from xpbd_ros.sim.backend.jit import jit
from xpbd_ros.sim.backend.simd_wide import load_wide, store_wide, WIDTH
from xpbd_ros.sim.contact import near_blocks
from xpbd_ros.sim.contact.broad_phase import search
from xpbd_ros.sim.contact.collider_motion import move_colliders
from xpbd_ros.sim.contact.colliders import (
    BOX,
    CAPSULE,
    CYLINDER,
    HEIGHTS,
    inner,
    MESH,
    new_colliders,
    PLANE,
    reach,
    SPHERE,
    steepness,
    to_local,
    write_grid,
    write_heights,
)
from xpbd_ros.sim.contact.contacts import (
    CORNER,
    count_penetrating,
    DEPENETRATION,
    new_contacts,
    push_all,
    push_candidate,
    push_once,
)
from xpbd_ros.sim.contact.corners import is_penetrating, leave_corners
from xpbd_ros.sim.contact.distance_field import distance_field
from xpbd_ros.sim.contact.pieces import candidate, CHUNK, LANES, rounds
from xpbd_ros.sim.contact.signed_distance import shape_distance, signed_distance
from xpbd_ros.sim.contact.signed_distance_simd import shape_depths, shape_distances
from xpbd_ros.sim.particles.history import History
from xpbd_ros.sim.particles.state import new_state, Substep

THICKNESS = 0.01
SUBSTEPS = 10
H = 1e-3
SIZES = {PLANE: (0.0, 0.0, 0.0), SPHERE: (0.12, 0.0, 0.0), CAPSULE: (0.05, 0.15, 0.0),
         CYLINDER: (0.1, 0.08, 0.0), BOX: (0.1, 0.15, 0.03)}


@jit(cache_name=None)
def by_lanes(shape, a, b, c, points, found):
    """Write φ, the normal and φ alone of points (3, n) to rows of ``found``."""
    n = points.shape[1]
    for q in range(0, n, WIDTH):
        x, y, z = load_wide(points, q), load_wide(points, n + q), load_wide(points, 2 * n + q)
        phi, nx, ny, nz = shape_distances(shape, a, b, c, x, y, z)
        store_wide(found, q, phi)
        store_wide(found, n + q, nx)
        store_wide(found, 2 * n + q, ny)
        store_wide(found, 3 * n + q, nz)
        store_wide(found, 4 * n + q, shape_depths(shape, a, b, c, x, y, z))


@jit(cache_name=None)
def one_by_one(shape, a, b, c, points, found):
    """Do the same by the kernel for one point."""
    for i in range(points.shape[1]):
        phi, nx, ny, nz = shape_distance(shape, a, b, c, points[0, i], points[1, i], points[2, i])
        found[0, i], found[1, i], found[2, i], found[3, i], found[4, i] = phi, nx, ny, nz, phi


@pytest.mark.parametrize('shape', SIZES)
def test_distances_by_lanes_have_the_bits_of_one_at_a_time(shape):
    a, b, c = SIZES[shape]
    random = np.random.default_rng(shape)
    special = np.array(np.meshgrid(*[[-1.0, -c, -b, -a, -0.0, 0.0, 1e-200, a, b, c, 1.0]] * 3))
    points = np.concatenate([random.uniform(-0.3, 0.3, (3, 2000)), special.reshape(3, -1)], 1)
    points = np.ascontiguousarray(points[:, :points.shape[1] // 8 * 8])
    found = np.zeros((2, 5, points.shape[1]))
    by_lanes(shape, a, b, c, points, found[0])
    one_by_one(shape, a, b, c, points, found[1])
    np.testing.assert_array_equal(found[0].view(np.int64), found[1].view(np.int64))


class World:
    """Particles that fly about among colliders of all shapes, some of which move and turn."""

    def __init__(self, speed, dtype, seed=1):
        self.random = random = np.random.default_rng(seed)
        count, slots = 300, 320
        self.count = count
        slot = np.sort(random.choice(slots - 16, count, replace=False))
        group = slot // 8    # small blocks, of which few are near a collider
        x = random.uniform(-0.5, 0.5, (slots // 8, 3))[group]
        self.state = new_state(x + random.uniform(-0.02, 0.02, (count, 3)),
                               np.full(count, 1e-3), (0.0, 0.0, -9.8), slot, slots, dtype=dtype)
        fresh = np.zeros(slots, dtype)
        self.state = self.state._replace(history=History(None, None, None, None, fresh, None))
        self.state.inv_mass[slot[::17]] = 0.0
        self.slot = slot
        velocity = speed * (random.normal(size=(slots // 8, 3))
                            * 10.0**random.uniform(-1, 0, (slots // 8, 1)))[group]
        self.state.v[:, slot] = velocity.T
        self.contacts = new_contacts(self._colliders(), 16 * count, THICKNESS, slots, 1)
        self.frame()

    def _colliders(self):
        field = distance_field(*box_surface(0.1, 0.1, 0.1), gap=THICKNESS)
        ground = 0.05 * self.random.random((5, 4))
        shapes = [*SIZES, SPHERE, BOX, MESH, HEIGHTS]
        colliders = new_colliders(len(shapes) + 3, field.values.size, ground.size)
        write_grid(colliders.grids, shapes.index(MESH), field, 0)
        write_heights(colliders.heights, shapes.index(HEIGHTS), ground, 0)
        for c, shape in enumerate(shapes):
            size = np.array(SIZES.get(shape, (0.4, 0.3, 0.0)))
            colliders.shape[c] = shape
            colliders.reach[c], colliders.inner[c] = reach(shape, size), inner(shape, size)
            if shape == MESH:
                colliders.reach[c], colliders.inner[c] = field.reach, 0.5 * field.spacing
            if shape == HEIGHTS:
                size[2] = steepness(ground, (0.8, 0.6))
                colliders.reach[c], colliders.inner[c] = -1.0 - ground.max(), 0.05
            colliders.size[c] = size
            colliders.goal[c, :3] = self.random.uniform(-0.4, 0.4, 3) - [0.0, 0.0, 0.5 * (c == 0)]
            colliders.goal[c, 3:] = Rotation.random(random_state=c).as_quat()
        colliders.count[0] = len(shapes)
        return colliders

    def frame(self, pace=0.0, *, moves=True):
        """Begin a frame; ``pace``: how far colliders move, if so, and turn in it [m, rad]."""
        colliders, n = self.contacts.colliders, self.contacts.colliders.count[0]
        colliders.start[:] = colliders.goal
        if pace:
            for c in range(1, n, 2):
                colliders.goal[c, :3] += moves * pace * self.random.normal(size=3)
                colliders.goal[c, 3:] = (Rotation.from_rotvec(pace * self.random.normal(size=3))
                                         * Rotation.from_quat(colliders.start[c, 3:])).as_quat()
        colliders.moving[:] = (colliders.start != colliders.goal).any(1)

    def substep(self, k):
        """Move all particles, and find the candidates; return whether the list was kept."""
        state, contacts, slot = self.state, self.contacts, self.slot
        substep = Substep(H, k / SUBSTEPS, (k + 1) / SUBSTEPS)
        state.x_prev[:] = state.x
        out = np.abs(state.x) > 0.6
        state.v[out] = -np.sign(state.x[out]) * np.abs(state.v[out])
        state.x[:, slot] += H * state.v[:, slot]
        move_colliders(contacts, None, substep)
        contacts.near.valid[0] *= 2
        search(contacts, None, state, substep)
        return contacts.near.valid[0] > 1


def brute_force(world):
    """Return the candidates (collider, slot) in their order, with gap and overlap."""
    contacts, state, found = world.contacts, world.state, []
    before, after = contacts.before, contacts.after
    for c in range(contacts.colliders.count[0]):
        bound = contacts.colliders.reach[c]
        for i in world.slot.tolist():
            x, x0 = state.x[:, i].astype(float).tolist(), state.x_prev[:, i].astype(float).tolist()
            away = np.subtract(x, after[c, :3])
            near = THICKNESS + 2.0 * (
                np.sqrt(sum((p - q)**2 for p, q in zip(x, x0))) + contacts.stir[0]
                + contacts.moved[c] + 2.0 * contacts.turned[c] * np.sqrt(sum(away * away)))
            phi = signed_distance(contacts.colliders, c, *to_local(after, c, *x))[0]
            if not (state.inv_mass[i] > 0.0 and phi <= near):
                continue
            if contacts.colliders.shape[c] in (MESH, HEIGHTS) and not near > (
                    np.linalg.norm(away) - bound if bound >= 0.0 else
                    away @ contacts.up[c] + 1.0 + bound):
                continue
            start = signed_distance(contacts.colliders, c, *to_local(before, c, *x0))[0]
            gap = min(THICKNESS, start + DEPENETRATION * H)
            found.append((c, i, gap, max(0.0, gap - start)))
    return found


@pytest.mark.parametrize('speed, pace, stir, dtype, kept_at_least', [
    (5.0, 0.3, 0.001, np.float64, 25), slow(5.0, 0.0, 0.0, np.float64, 25),
    slow(0.0, 0.3, 0.0, np.float64, 25), slow(0.0, 0.0, 0.0, np.float64, 39),
    slow(50.0, 0.0, 0.0, np.float64, 0), slow(0.5, 0.02, 0.0, np.float32, 25)])
def test_candidates_are_those_of_brute_force(speed, pace, stir, dtype, kept_at_least):
    world = World(speed, dtype)
    contacts, kept, most = world.contacts, 0, 0
    contacts.stir[0] = stir
    for k in range(60):
        if k % SUBSTEPS == 0:
            world.frame(pace)
        kept += world.substep(k % SUBSTEPS)
        n = contacts.count[0]
        assert list(zip(contacts.collider[:n].tolist(), contacts.particle[:n].tolist(),
                        contacts.gap[:n].tolist(), contacts.overlap[:n].tolist())) == (
                            brute_force(world))
        links, last = [], {}
        for at, i in enumerate(contacts.particle[:n].tolist()):
            links.append(last.get(i, -1))
            last[i] = at
        assert contacts.earlier[:n].tolist() == links
        assert contacts.count[3] == (max(links, default=-1) >= 0)
        most = max(most, n)
    assert most > 50
    assert kept >= kept_at_least


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('moves', [True, False])
def test_a_collider_that_sets_off_finds_candidates(moves, seed):
    """The list is built while the colliders creep, with small budgets."""
    world = World(0.0, np.float64, seed)
    before = None
    for pace in (1e-4, 0.3 if moves else 2.0):
        world.frame(pace, moves=moves)
        for k in range(SUBSTEPS):
            world.substep(k)
            n = world.contacts.count[0]
            found = list(zip(world.contacts.collider[:n].tolist(),
                             world.contacts.particle[:n].tolist()))
            assert found == [pair[:2] for pair in brute_force(world)]
            before = found if before is None else before
    assert not set(found) <= set(before)


def test_colliders_without_room_in_the_list_are_tested_against_all(monkeypatch):
    world = World(0.5, np.float64)
    near = world.contacts.near
    world.contacts = world.contacts._replace(near=near._replace(block=near.block[:45]))
    for k in range(SUBSTEPS):
        world.substep(k)
        assert near.end.min() == near_blocks.ALL
        n = world.contacts.count[0]
        assert list(zip(world.contacts.collider[:n], world.contacts.particle[:n])) == [
            pair[:2] for pair in brute_force(world)]


@jit(cache_name=None)
def push_singly(contacts, state, back, eased):
    """Project all candidates, one after another."""
    held_back, count = False, contacts.count[0]
    for n in range(count):
        held_back |= push_candidate(contacts, count - 1 - n if back else n, state, back, eased)
    if held_back or not back:
        contacts.count[2] = held_back


@jit(cache_name=None)
def push_all_singly(contacts, state, eased):
    """Do the same as ``push_all``."""
    for _ in range(CORNER):
        push_singly(contacts, state, False, eased)
        if not contacts.count[2]:
            break
    if contacts.count[3]:
        push_singly(contacts, state, True, eased)
        leave_corners(contacts, state)


@jit(cache_name=None)
def resist_singly(friction, state, substep):
    """Do the same as ``resist``."""
    contacts = friction.contacts
    for k in range(contacts.count[0]):
        resist_candidate(friction, k, state)
    if contacts.count[2]:
        push_once(contacts, state, False, False)
    leave_corners(contacts, state)


@jit(cache_name=None)
def count_singly(contacts, state):
    """Do the same as ``count_penetrating``."""
    count = 0
    for k in range(contacts.count[0]):
        count += is_penetrating(contacts, k, state)
    return count


@pytest.mark.parametrize('speed, pace, dtype', [
    (3.0, 0.2, np.float64), slow(0.5, 0.1, np.float32), slow(0.1, 0.0, np.float64)])
def test_pushes_and_friction_have_the_bits_of_one_at_a_time(speed, pace, dtype):
    worlds = [World(speed, dtype) for _ in range(2)]
    touched = crossed = inside = 0
    for world in worlds:    # two cloths, friction by cloth and collider
        capacity = len(world.contacts.colliders.shape)
        world.friction = Friction(
            world.contacts, np.repeat([0, 1], [100, 220]),
            np.linspace(0.0, 0.8, 2 * capacity).reshape(2, capacity),
            np.linspace(0.1, 1.2, 2 * capacity).reshape(2, capacity))
    for k in range(20):
        substep = Substep(H, k % SUBSTEPS / SUBSTEPS, (k % SUBSTEPS + 1) / SUBSTEPS)
        for world, push, rub in zip(worlds, (push_all, push_all_singly), (resist, resist_singly)):
            if k % SUBSTEPS == 0:
                world.frame(pace)
            world.substep(k % SUBSTEPS)
            for eased in (False, False, True):
                push(world.contacts, world.state, eased)
                rub(world.friction, world.state, substep)
        (one, other), n = [world.contacts for world in worlds], worlds[0].contacts.count[0]
        for name in ('push', 'normal', 'slip', 'crossed', 'side', 'particle'):
            a, b = getattr(one, name)[:n], getattr(other, name)[:n]
            np.testing.assert_array_equal(a.view(np.uint8), b.view(np.uint8), name)
        for a, b in ((worlds[0].state.x, worlds[1].state.x),
                     (worlds[0].state.history.fresh, worlds[1].state.history.fresh)):
            np.testing.assert_array_equal(a.view(np.uint8), b.view(np.uint8))
        assert count_penetrating(one, worlds[0].state) == count_singly(other, worlds[1].state)
        touched += (one.push[:n] > 0.0).sum()
        crossed += one.crossed[:n].sum()
        inside += count_singly(other, worlds[1].state)
    assert touched > 200
    assert crossed > 0 or speed < 1.0


@jit(cache_name=None)
def take(team, begin, end, taken):
    for n in range(rounds(team, begin, end)):
        k = candidate(team, n, begin)
        if k < end:
            taken[k] += team.worker + 1


@pytest.mark.parametrize('workers', [1, 3, 16, 1000])
@pytest.mark.parametrize('count', [0, 1, 63, 64, 65, 1000])
def test_one_thread_of_a_gpu_has_all_candidates_of_a_partial_sum(count, workers):
    begin, taken = 7, np.zeros(7 + count, np.int64)
    for worker in range(workers):
        take(DeviceTeam(worker, workers, 1, np.zeros(1, np.int64)), begin, begin + count, taken)
    n = np.arange(count)
    owner = (n // CHUNK * LANES + n % LANES) % workers
    np.testing.assert_array_equal(taken[begin:], owner + 1)
    assert (taken[:begin] == 0).all()
