"""Pedipulation and the parkour skills: courses against mj_ray, spawns, levels, scans, mirrors, rewards, endings."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import envs
from envs import courses, parkour

SKILLS = {
    "anymal_parkour_walk": "walk",
    "anymal_climb_up": "climb_up",
    "anymal_climb_down": "climb_down",
    "anymal_crouch": "crouch",
    "anymal_jump": "jump",
}
N = 30  # episodes, three of each level


def at_levels(env):
    """N episode starts, level i % 10."""
    reset = jax.jit(jax.vmap(lambda key, level: env.reset(key, curriculum=env.at_level(level))))
    return reset(jax.random.split(jax.random.key(0), N), jnp.arange(N) % 10)


@pytest.fixture(scope="module")
def started(jitted):
    """task -> environment and its N starts, made once; with other fields of its config those of another one."""

    @functools.cache
    def get(task, **fields):
        env = jitted(task, **fields).env
        return env, at_levels(env)

    return get


@pytest.fixture(scope="module")
def one(started):
    """task -> environment and its first start, on level 0."""

    def get(task, **fields):
        env, state = started(task, **fields)
        return env, jax.tree.map(lambda x: x[0], state)

    return get


def simulation(env, state, i):
    """MjData of one start, everything computed."""
    data = mujoco.MjData(env.model)
    data.qpos[:] = np.asarray(state.physics.qpos[i], np.float64)
    data.mocap_pos[:], data.mocap_quat[:] = (
        np.asarray(x[i]) for x in (state.physics.mocap_pos, state.physics.mocap_quat)
    )
    mujoco.mj_forward(env.model, data)
    return data


def ray(env, data, start, direction):
    """Distance from start to the first geom of the scene along a direction, the robot out of the way."""
    geom = np.zeros(1, np.int32)
    return mujoco.mj_ray(env.model, data, np.asarray(start, np.float64), np.array([0, 0, direction]), None, 1, -1, geom)


@pytest.mark.parametrize("task", SKILLS)
def test_scans_are_what_rays_meet(task, started):
    """Ground under and ceiling over 100 random points of each start, ramps and stairs included."""
    env, state = started(task)
    heights = jax.jit(env.ground_height)
    rng = np.random.default_rng(0)
    for i in range(N):
        data = simulation(env, state, i)
        data.qpos[0] = 100.0
        mujoco.mj_kinematics(env.model, data)
        xy = rng.uniform([-1.5, -1.9], [5.5, 1.9], (100, 2))
        start = jax.tree.map(lambda x, i=i: x[i], state.physics)
        table = data.mocap_pos[env.overhead]
        from_z = 5.0 if not len(table) or table[0, 2] < 0 else table[0, 2] - 0.26
        found = [from_z - ray(env, data, [*point, from_z], -1.0) for point in xy]
        np.testing.assert_allclose(heights(start, jnp.asarray(xy)), found, atol=2e-3)
        if env.overhead.any():
            half = env.half[env.overhead]
            under = parkour.terrain.underside_heights(start.mocap_pos[env.overhead], half, jnp.asarray(xy))
            for point, height in zip(xy, np.asarray(under), strict=True):
                up = ray(env, data, [*point, 0.3], 1.0)
                assert (up < 0 and np.isinf(height)) or abs(0.3 + up - height) < 2e-3


@pytest.mark.parametrize("task", SKILLS)
def test_robots_start_on_the_ground_and_inside_nothing(task, started):
    env, state = started(task)
    for i in range(N):
        data = simulation(env, state, i)
        feet = np.array([data.site(foot).xpos for foot in env.robot.feet])
        start = jax.tree.map(lambda x, i=i: x[i], state.physics)
        gap = feet[:, 2] - env.robot.sole - np.asarray(env.ground_height(start, jnp.asarray(feet[:, :2])))
        assert np.abs(gap).max() < 0.01
        assert min((contact.dist for contact in data.contact[: data.ncon]), default=0.0) > -1e-3


def slab(name, skill, poses):
    names = [slab.name for slab in courses.all_slabs(courses.SKILLS[skill])]
    return np.asarray(poses)[:, names.index(name)]


@pytest.mark.parametrize("level", range(10))
def test_levels_are_what_the_table_says(level):
    """Box height, clearance, gap and stair rise of a level; a fifth of the episodes have rough tiles instead."""
    t = level / 9
    keys = jax.random.split(jax.random.key(level), 300)
    draw = {
        name: jax.vmap(lambda k, s=skill: courses.draw_course(s, k, t, 0.2))(keys)
        for name, skill in courses.SKILLS.items()
    }
    for skill, height in (("climb_up", 0.1 + 0.9 * t), ("climb_down", 0.1 + 0.9 * t)):
        block = slab("block", skill, draw[skill][0])
        used = block[:, 2] > -10
        assert 0.7 < used.mean() < 0.9 and (used == ~draw[skill][2]).all()
        np.testing.assert_allclose(block[used, 2] + 1.0, height, atol=1e-5)
    table = slab("table", "crouch", draw["crouch"][0])
    table = table[table[:, 2] > -10]
    np.testing.assert_allclose(table[:, 2] - 0.25, 0.9 - 0.5 * t, atol=1e-5)
    near, far = (slab(name, "jump", draw["jump"][0]) for name in ("near_platform", "far_platform"))
    gap = far[:, 0] - near[:, 0] - 3.0
    np.testing.assert_allclose(np.unique(gap.round(4)), np.unique(np.round([0, 0.1 + 0.9 * t], 4)), atol=1e-3)
    np.testing.assert_allclose(near[:, 2] + 0.5, 0.0, atol=1e-6)
    assert ((gap < 1e-3) == draw["jump"][2]).all() and not draw["walk"][2].any()
    tops = np.stack([slab(f"plank{i}", "walk", draw["walk"][0])[:, 2] for i in range(8)], 1) + 1.2
    rise = np.diff(tops, axis=1)
    stairs = (np.ptp(rise, axis=1) < 1e-4) & (tops[:, 0] > -10)
    assert 0.5 < stairs.mean() < 0.7
    np.testing.assert_allclose(np.abs(rise[stairs]), 0.05 + 0.2 * t, atol=1e-4)
    assert 0.3 < (rise[stairs, 0] > 0).mean() < 0.7, "up and down"
    uneven, most = tops[(tops[:, 0] > -10) & ~stairs], 0.05 + 0.2 * t
    assert 0 <= uneven.min() < 0.1 * most and 0.9 * most < uneven.max() <= most + 1e-5
    tiles = np.stack([slab(f"tile{i}", "climb_up", draw["climb_up"][0])[:, 2] for i in range(12)], 1)
    tiles, most = tiles[tiles[:, 0] > -10] + courses.TILES[0].half[2], 0.02 + 0.06 * t
    assert 0 <= tiles.min() < 0.1 * most and 0.9 * most < tiles.max() <= most + 1e-5
    tilt = slab("ramp", "walk", draw["walk"][0])
    tilt = tilt[tilt[:, 2] > -10, 3]
    assert 0.1 < len(tilt) / 300 < 0.3
    np.testing.assert_allclose(np.abs(tilt), 0.45 * t, atol=1e-6)
    assert t == 0 or 0.2 < (tilt > 0).mean() < 0.8, "up and down"


@pytest.mark.parametrize("task", SKILLS)
def test_goals_lie_behind_the_obstacle(task, started):
    """Half a metre above the ground, on, below or behind what the level has."""
    env, state = started(task)
    plain, t = ~np.asarray(state.task.rough), np.arange(N) % 10 / 9
    start, goal = state.physics.qpos[:, None, :2], state.task.goal[:, None, :2]
    way = start + jnp.linspace(0, 1, 300)[:, None] * (goal - start)
    p = state.physics
    ground = np.asarray(jax.jit(jax.vmap(env.ground_height))(p, way))[plain]
    np.testing.assert_allclose(np.asarray(state.task.goal[:, 2])[plain] - ground[:, -1], 0.5, atol=1e-3)
    rise, t = ground[:, -1] - ground[:, 0], t[plain]
    if task in ("anymal_climb_up", "anymal_climb_down"):
        np.testing.assert_allclose(rise if "up" in task else -rise, 0.1 + 0.9 * t, atol=1e-3)
    elif task == "anymal_jump":
        assert (ground.min(1) == -1).all() and np.abs(rise).max() < 1e-3
    elif task == "anymal_parkour_walk":
        assert np.ptp(ground, axis=1)[t > 0].min() > 0.02
    else:
        under = jax.jit(jax.vmap(lambda pos, xy: parkour.terrain.underside_heights(pos, env.half[env.overhead], xy)))
        under = np.asarray(under(p.mocap_pos[:, env.overhead], way))[plain]
        np.testing.assert_allclose(under.min(1), 0.9 - 0.5 * t, atol=1e-3)
        assert np.isinf(under[:, [0, -1]]).all()


EXACT = {"noise": 0.0, "scan_shift": 0.0, "push_velocity": 0.0, "added_mass": (0.0, 0.0)}


@pytest.mark.parametrize("task", ["anymal_climb_up", "anymal_crouch"])
def test_height_observation_without_noise(task, started):
    """Value (i, j) is base height - ground - 0.5 at x = -1 + 0.1 i, y = -0.5 + 0.1 j of the heading frame, times 2."""
    env, state = started(task, **EXACT)
    start = env.obs_dim - (231 + 66 * bool(env.overhead.any()))
    for i in range(0, N, 7):
        data = simulation(env, state, i)
        base, yaw = data.qpos[:3].copy(), float(env.motion(jax.tree.map(lambda x: x[i], state.physics)).yaw)
        data.qpos[0] = 100.0
        mujoco.mj_kinematics(env.model, data)
        for row, column in ((0, 0), (20, 0), (20, 10), (10, 5), (13, 2)):
            x, y = -1 + 0.1 * row, -0.5 + 0.1 * column
            at = base[0] + np.cos(yaw) * x - np.sin(yaw) * y, base[1] + np.sin(yaw) * x + np.cos(yaw) * y
            from_z = 0.35 if env.overhead.any() else 5.0
            ground = from_z - ray(env, data, [*at, from_z], -1.0)
            want = 2 * np.clip(base[2] - ground - 0.5, -1, 1)
            assert state.obs[i, start + 11 * row + column] == pytest.approx(want, abs=5e-3)


@pytest.mark.parametrize("mirror", ["left_right", "front_back"])
def test_scans_are_mirrored_point_by_point(mirror, started):
    """A point of the mirrored scan holds the reading of the reflected point."""
    env, _ = started("anymal_crouch", **EXACT)
    reflection = {"left_right": [1, -1], "front_back": [-1, 1]}[mirror]
    for kind, grid in parkour.GRIDS.items():
        perm, sign = env.mirror_block(mirror, kind)
        points = grid.reshape(-1, 2)
        np.testing.assert_allclose(points[perm], points * reflection, atol=1e-12)
        assert np.all(sign == 1)


def test_the_ceiling_scan_and_the_shift_of_the_map(started):
    """What rays meet above each point; a map that is shifted down has both its ground and its ceiling lower."""
    env, state = started("anymal_crouch", **EXACT)
    where = env.obs_slices()["ceiling"]
    sense = jax.jit(lambda motion, task: env.sense(jax.random.key(0), motion, task)[0])
    seen = 0
    for i in range(9, N, 10):  # the lowest tables
        data, one = simulation(env, state, i), jax.tree.map(lambda x, i=i: x[i], state)
        motion = env.motion(one.physics)
        base, yaw = data.qpos[:3].copy(), float(motion.yaw)
        data.qpos[0] = 100.0
        mujoco.mj_kinematics(env.model, data)
        for number, (x, y) in enumerate(parkour.CEILING_GRID.reshape(-1, 2)):
            at = base[0] + np.cos(yaw) * x - np.sin(yaw) * y, base[1] + np.sin(yaw) * x + np.cos(yaw) * y
            up = ray(env, data, [*at, 0.3], 1.0)
            want = 1.0 if up < 0 else np.clip(0.3 + up - base[2], 0.0, 1.0)
            scale = np.broadcast_to(env.OBS["ceiling"][1], where.stop - where.start)[number]
            assert state.obs[i, where][number] / scale == pytest.approx(want, abs=5e-3)
            seen += want < 1.0
        low, flat = (sense(motion, one.task.replace(shift=jnp.array([0.0, 0.0, z]))) for z in (0.05, 0.0))
        inside = (np.asarray(flat["ceiling"]) > 0.1) & (np.asarray(flat["ceiling"]) < 1.0)
        np.testing.assert_allclose((low["ceiling"] - flat["ceiling"])[inside], -0.05, atol=1e-5)
        np.testing.assert_allclose(low["height"] - flat["height"], 0.05, atol=1e-5)
    assert seen > 0


def test_inputs_of_the_task_worked_out_by_hand(one):
    """A robot that looks 0.7 rad to the left, a goal 2 m ahead and 1 m to its left, a quarter of the time gone."""
    env, state = one("anymal_climb_up")
    motion = env.motion(state.physics).replace(base_pos=jnp.array([3.0, -2.0, 0.6]), yaw=jnp.float32(0.7))
    ahead, left = np.array([np.cos(0.7), np.sin(0.7)]), np.array([-np.sin(0.7), np.cos(0.7)])
    task = state.task.replace(goal_yaw=jnp.float32(0.7 + 0.4))

    def inputs(forward, sideways, up, clock):
        goal = jnp.array([*(np.array([3.0, -2.0]) + forward * ahead + sideways * left), 0.6 + up], jnp.float32)
        return env.task_inputs(task.replace(goal=goal), motion, clock)

    near = inputs(2.0, 1.0, 0.5, env.episode_steps // 4)
    np.testing.assert_allclose(near["goal"], [2.0, 1.0, 0.5], atol=1e-5)
    np.testing.assert_allclose(near["heading"], [np.sin(0.4), np.cos(0.4)], atol=1e-6)
    assert float(near["time_left"]) == pytest.approx(0.75)
    np.testing.assert_allclose(inputs(6.0, 8.0, 0.0, 0)["goal"], [3.0, 4.0, 0.0], atol=1e-4)  # no farther than 5 m


def test_an_episode_starts_with_its_distance_and_a_heading_near_the_goal(started):
    env, state = started("anymal_climb_up")
    way = np.asarray(state.task.goal[:, :2] - state.physics.qpos[:, :2])
    np.testing.assert_allclose(state.task.start_distance, np.hypot(*way.T), rtol=1e-6)
    turn = np.asarray(state.task.goal_yaw) - np.arctan2(way[:, 1], way[:, 0])
    assert np.abs(turn).max() <= 0.3 and np.ptp(turn) > 0.3
    assert np.abs(state.task.shift).max() <= 0.075 and np.all(np.ptp(np.asarray(state.task.shift), axis=0) > 0.1)
    one = jax.tree.map(lambda x: x[0], state)
    motion = env.motion(one.physics)
    assert 0 < np.mean(state.task.rough) < 0.5, "some episodes are on rough ground"
    xy = env.grid(parkour.HEIGHT_GRID, motion, one.task)
    still = env.grid(parkour.HEIGHT_GRID, motion, one.task.replace(shift=jnp.zeros(3)))
    np.testing.assert_allclose(xy - still, np.broadcast_to(one.task.shift[:2], xy.shape), atol=1e-6)
    seen = motion.base_pos[2] - env.ground_height(motion, xy) - 0.5 + one.task.shift[2]
    noise = np.asarray(one.obs[env.obs_slices()["height"]] / 2 - seen)[np.abs(seen) < 0.9]
    assert np.abs(noise).max() <= 0.0501 and noise.min() < -0.04 and noise.max() > 0.04


def mirrored_start(env, mirror, state):
    """The same episodes with robot, slabs and goal reflected."""
    polar = jnp.array({"left_right": [1.0, -1, 1], "front_back": [-1.0, 1, 1]}[mirror])
    axial = -polar
    perm, sign = env.robot.mirror_joints(mirror)
    p = state.physics
    quat = jnp.concatenate([jnp.ones(1), axial])  # a turn's axis is axial
    other = p.replace(
        qpos=jnp.concatenate([p.qpos[:, :3] * polar, p.qpos[:, 3:7] * quat, p.qpos[:, 7:][:, perm] * sign], 1),
        qvel=jnp.concatenate([p.qvel[:, :3] * polar, p.qvel[:, 3:6] * axial, p.qvel[:, 6:][:, perm] * sign], 1),
        mocap_pos=p.mocap_pos * polar,
        mocap_quat=p.mocap_quat * quat,
    )
    return state.replace(
        physics=other, task=state.task.replace(goal=state.task.goal * polar, goal_yaw=-state.task.goal_yaw)
    )


@pytest.mark.parametrize("task", ["anymal_climb_up", "anymal_crouch"])
def test_mirrored_scene_gives_mirrored_observation_and_motion(task, jitted, started):
    """Reflect robot, slabs and goal; the observation is the mirrored one, and so it stays for ten control steps.

    A box and a table overhead; the slabs of the other skills are seen by rays and by mirrored scans.
    """
    exact, (env, start) = jitted(task, **EXACT), started(task, **EXACT)
    for mirror in env.mirrors:
        compare_mirrored(exact, mirror, start, mirrored_start(env, mirror, start))


def compare_mirrored(exact, mirror, state, twin):
    """Step both with mirrored actions; nine in ten robots must stay each other's image."""
    for i in range(10):
        action = 0.3 * jax.random.normal(jax.random.key(i), (N, 12))
        state, twin = exact.step(state, action), exact.step(twin, exact.env.mirror(mirror, "action", action))
        alive = ~np.asarray(state.terminated | twin.terminated | state.truncated)
        want = np.asarray(exact.env.mirror(mirror, "obs", state.final_obs))
        close = np.abs(np.asarray(twin.final_obs) - want)[:, :51].max(1) < 2e-2  # scans jump at edges
        assert close[alive].mean() > 0.9, i


KEY = jax.random.key(1)


@pytest.fixture(scope="module")
def climb_up(one):
    """anymal_climb_up and one start."""
    return one("anymal_climb_up")


def rule(*where, **task):
    """The next level and best of an environment at a level whose episode ends, standing, at a distance."""
    return curriculum(*where, **task)[:2]


def curriculum(env, state, level, distance, start_distance, terminated, best=0, rough=False, reached=0, key=KEY):
    """As `rule`, and the highest level reached."""
    task = state.task.replace(
        level=jnp.int32(level),
        best=jnp.int32(best),
        reached=jnp.int32(reached),
        feet_only=jnp.int32(50),
        start_distance=jnp.float32(start_distance),
        rough=jnp.array(rough),
    )
    motion = env.motion(state.physics)
    goal = motion.base_pos + jnp.array([distance, 0.0, 0.0])
    ended = jnp.asarray(terminated)
    after = env.next_curriculum(key, task.replace(goal=goal), motion, ended, ~ended)
    return int(after["level"]), int(after["best"]), int(after["reached"])


def test_promotion_and_demotion(climb_up):
    env, state = climb_up
    assert rule(env, state, 3, 0.3, 2.0, False) == (4, 3)  # there in time: level 3 is solved
    assert rule(env, state, 3, 0.8, 2.0, False) == (3, 0)  # over half way
    assert rule(env, state, 3, 1.2, 2.0, False, best=7) == (2, 7)  # not half way; the best stays
    assert rule(env, state, 3, 0.3, 2.0, True)[0] == 2  # fell, although there
    assert rule(env, state, 0, 1.9, 2.0, False) == (0, 0)
    assert rule(env, state, 9, 0.1, 2.0, False, best=8)[1] == 9
    levels = {rule(env, state, 9, 0.1, 2.0, False, key=jax.random.key(i))[0] for i in range(60)}
    assert levels == {*range(10)}, "after the last level come all of them"


def test_the_highest_level_reached_never_falls(climb_up):
    """It counts a level that was drawn, not one that was solved, and ends at the last one."""
    env, state = climb_up
    assert curriculum(env, state, 3, 0.3, 2.0, False, reached=3) == (4, 3, 4)
    assert curriculum(env, state, 4, 1.9, 2.0, False, best=3, reached=4) == (3, 3, 4)
    assert curriculum(env, state, 0, 1.9, 2.0, False)[2] == 0
    assert curriculum(env, state, 9, 0.1, 2.0, False, best=8, reached=9)[2] == 9
    assert curriculum(env, state, 3, 0.3, 2.0, False, reached=3, rough=True)[2] == 3
    task = state.task.replace(level=jnp.int32(2), best=jnp.int32(3), reached=jnp.int32(6))
    shown = env.task_metrics(task, env.motion(state.physics), jnp.asarray(True))
    assert float(shown["progress"]) == pytest.approx(3 / 9) and float(shown["progress_reached"]) == pytest.approx(6 / 9)
    assert int(env.at_level(5)["reached"]) == 5


def standing(env, state):
    """Motion and task of a robot that has stood at its goal for a second. The ground under it is at 0.2 m."""
    motion = env.motion(state.physics)
    slabs = motion.mocap_pos.at[0].set(motion.base_pos - jnp.array([0.0, 0.0, 0.5 + env.half[0, 2]]))
    motion = motion.replace(
        gravity=jnp.array([0.0, 0.0, -1.0]),
        mocap_pos=slabs,
        sensors=jnp.zeros_like(motion.sensors),
        joint_pos=jnp.zeros(12),
    )
    task = state.task.replace(goal=motion.base_pos, feet_only=jnp.int32(50))
    return motion, task


def tilted(motion, degrees):
    """Motion pitched nose-down."""
    angle = np.deg2rad(degrees)
    return motion.replace(gravity=jnp.array([np.sin(angle), 0.0, -np.cos(angle)], jnp.float32))


def lowered(motion, height):
    """Motion with the base at a height above the ground under it, which was 0.5 m below."""
    return motion.replace(base_pos=motion.base_pos.at[2].add(height - 0.5))


def test_success_is_to_stand_on_the_feet_at_the_goal(climb_up):
    """Each line but the first breaks one condition: place, time, tilt, height above the ground, contacts."""
    env, state = climb_up
    motion, task = standing(env, state)

    def success(motion=motion, task=task, truncated=True):
        return bool(env.succeeded(task, motion, jnp.asarray(truncated)))

    assert success() and success(tilted(motion, 24.0)) and success(lowered(motion, 0.36))
    assert not success(truncated=False)
    assert success(task=task.replace(goal=motion.base_pos + jnp.array([0.49, 0, 0])))
    assert not success(task=task.replace(goal=motion.base_pos + jnp.array([0.51, 0, 0])))
    assert not success(tilted(motion, 26.0)) and not success(tilted(motion, 60.0)), "nose-down"
    assert not success(tilted(motion, 180.0)), "on its back"
    assert float(motion.base_pos[2]) > 0.5 and not success(lowered(motion, 0.34)), "lying on a box"
    assert not success(task=task.replace(feet_only=jnp.int32(5))), "a knee touched 0.1 s ago"
    assert success(task=task.replace(feet_only=jnp.int32(10)))


@pytest.mark.parametrize("body", ["base", "LF_knee", "RH_thigh", "RF_shank"])
def test_the_time_on_the_feet_alone_starts_again_at_a_touch(body, climb_up):
    """Of any body but a foot. The sensor is looked up in the MJCF by its name."""
    env, state = climb_up
    motion, task = standing(env, state)

    def touch(name, force):
        sensor = env.model.sensor(f"{name}_force")
        return motion.replace(sensors=motion.sensors.at[sensor.adr[0] + 2].set(force))

    task = env.before_rewards(task, touch("LF_foot", 200.0))
    assert int(task.feet_only) == 51, "feet may touch"
    task = env.before_rewards(task, touch(body, 5.0))
    assert int(task.feet_only) == 0
    for _ in range(9):
        task = env.before_rewards(task, motion)
    assert not bool(env.succeeded(task, motion, jnp.asarray(True)))
    task = env.before_rewards(task, motion)
    assert bool(env.succeeded(task, motion, jnp.asarray(True)))


@pytest.fixture(scope="module")
def calm(jitted):
    """anymal_climb_up without what is random, and where the trunk may touch the ground."""
    fields = {"rough": 0.0, "noise": 0.0, "spawn_velocity": 0.0, "push_velocity": 0.0, "base_force": 1e6}
    return jitted("anymal_climb_up", **fields)


def test_a_robot_that_holds_its_pose_succeeds_and_one_on_its_belly_does_not(calm):
    """In the simulator: the goal is where it stands, and the time is up after a second; legs folded, it lies."""
    task = calm
    state = task.start(2)
    state = state.replace(clock=jnp.full(2, task.env.episode_steps - 50))
    state = state.replace(task=state.task.replace(goal=state.physics.qpos[:, :3]))
    folded = jnp.array([0.0, 1.4, -1.9] * 2 + [0.0, -1.4, 1.9] * 2)
    action = jnp.stack([jnp.zeros(12), folded / task.env.action_scale])
    for _ in range(50):
        state = task.step(state, action)
    assert np.asarray(state.truncated).all() and np.asarray(state.metrics["goal_distance"] < 0.5).all()
    np.testing.assert_array_equal(state.metrics["episode_success"], [1.0, 0.0])
    np.testing.assert_array_equal(state.task.level, [1, 0])


def test_standing_up_at_the_goal_pays_at_every_step(climb_up):
    """`on_feet` is 1 on the feet, and rises as tilt, contacts or a low base are mended one by one."""
    env, state = climb_up
    motion, task = standing(env, state)

    def paid(motion, clock=280, task=task):
        return float(env.rewards(task, motion, jnp.zeros(12), jnp.zeros(12), clock)["on_feet"])

    def kneeling(motion, *bodies):
        where = np.array([env.model.sensor(f"{name}_force").adr[0] for name in bodies])
        return motion.replace(sensors=motion.sensors.at[where].set(5.0))

    assert paid(motion) == pytest.approx(1.0) and paid(tilted(motion, 24.0)) == pytest.approx(1.0)
    rising = [kneeling(tilted(lowered(motion, 0.2), 60.0), "LF_knee", "RF_knee")]
    rising += [kneeling(tilted(lowered(motion, 0.2), 60.0), "LF_knee"), tilted(lowered(motion, 0.2), 60.0)]
    rising += [tilted(lowered(motion, 0.2), 40.0), tilted(lowered(motion, 0.3), 40.0), lowered(motion, 0.3), motion]
    values = [paid(one) for one in rising]
    assert values[0] > 0 and (np.diff(values) > 0.02).all(), values
    assert values[0] == pytest.approx(0.3 * (0.2 / 0.35) / 3, rel=1e-3)
    assert paid(motion, clock=200) == 0.0, "before the last second"
    assert paid(motion, task=task.replace(goal=motion.base_pos + jnp.array([0.6, 0, 0]))) == 0.0, "elsewhere"


def test_rough_ground_moves_no_level(climb_up):
    """Neither success nor failure there says anything about the obstacle."""
    env, state = climb_up
    assert rule(env, state, 3, 0.3, 2.0, False, best=1, rough=True) == (3, 1)
    assert rule(env, state, 3, 0.3, 2.0, True, best=1, rough=True) == (3, 1)


def test_fixed_level_stays(climb_up):
    """It is the level of an environment's first episode and of the next."""
    env, (_, state) = envs.make("anymal_climb_up", "c", level=6), climb_up
    assert int(env.first_curriculum()["level"]) == 6 and rule(env, state, 6, 0.1, 2.0, False)[0] == 6


def test_level_survives_the_reset_and_moves_the_box(calm):
    """An environment that ends its episode in failure starts again one level lower, its box lower too."""
    state = calm.start(2)
    upside_down = state.physics.qpos.at[0, 3:7].set(jnp.array([0.0, 1, 0, 0])).at[0, 2].set(1.5)
    task = state.task.replace(level=jnp.full(2, 5, jnp.int32))
    after = calm.hold(state.replace(physics=state.physics.replace(qpos=upside_down), task=task))
    assert after.terminated.tolist() == [True, False] and after.task.level.tolist() == [4, 5]
    assert not np.any(after.task.best)
    assert float(after.physics.mocap_pos[0, 0, 2]) + 1.0 == pytest.approx(0.1 + 0.9 * 4 / 9, abs=1e-4)


def test_time_limit_is_an_end_without_bootstrap():
    env = envs.make("anymal_climb_up", "c")
    assert not env.bootstrap_time_outs and env.episode_steps == 300
    clocks = jax.jit(jax.vmap(lambda k: env.reset(k).clock))(jax.random.split(jax.random.key(0), 200))
    assert 0 <= clocks.min() < 10 and 90 < clocks.max() <= 100  # 4 to 6 s


def test_falling_into_the_pit_ends_a_jump(one):
    env, state = one("anymal_jump")
    motion = env.motion(state.physics)
    failed = [env.failed(state.task, motion.replace(base_pos=jnp.array([-5.0, 0.0, z]))) for z in (-0.4, 0.6)]
    assert [bool(x) for x in failed] == [True, False]


def test_foot_force_and_base_contact_end_an_episode(one):
    env, state = one("anymal_climb_down")
    motion = env.motion(state.physics)

    def ends(**forces):
        return bool(env.failed(state.task, motion.replace(**forces)))

    foot = jnp.zeros((4, 3)).at[2, 2]
    sensors = motion.sensors.at[env.end_sensors[0]]
    assert not ends(foot_force=foot.set(1990.0)) and ends(foot_force=foot.set(2010.0))
    assert not ends(sensors=sensors.set(0.5)) and ends(sensors=sensors.set(2.0))


def test_parkour_rewards_by_hand(climb_up):
    """Each term on a motion whose numbers are chosen so that the answer is plain."""
    env, state = climb_up
    motion, zero = env.motion(state.physics), jnp.zeros(12)
    motion = motion.replace(
        base_pos=jnp.zeros(3),
        quat=jnp.array([1.0, 0, 0, 0]),
        yaw=jnp.float32(0),
        lin_vel=jnp.array([1.0, 0, 0]),
        joint_pos=zero,
        joint_vel=zero.at[0].set(9.0).at[1].set(20.0),
        torque=zero.at[3].set(2.0),
        base_acc=jnp.array([3.0, 4.0, 0, 10.0, 0, 0]),
        foot_force=jnp.array([[0.0, 0, 800], [30.0, 0, 10], [0, 0, 0], [0, 0, 5000]]),
    )
    task = state.task.replace(
        goal=jnp.array([2.0, 0, 0]),
        goal_yaw=jnp.float32(0.4),
        foot_acc=jnp.zeros((4, 3)).at[0, 0].set(30.0).at[1, 2].set(900.0),
    )
    got = env.rewards(task, motion, zero.at[5].set(0.5), zero, 280)
    want = {
        "position": 0.0,  # 1 - 0.5 * 2
        "heading": 0.0,  # too far
        "approach": 2.0 / (2.0 + 0.1),
        "wait": 0.0,
        "stand": 0.0,
        "joint_vel": 81.0 + 400.0,
        "torque": 4.0,
        "joint_vel_limit": 0.5 + 1.0,
        "base_acc": 25.0 + 0.02 * 100.0,
        "feet_acc": 30.0 + 100.0,
        "action_rate": 0.25,
        "feet_force": 100.0**2 + 700.0**2,
        "stumble": 1.0,
    }
    for name, value in want.items():
        assert float(got[name]) == pytest.approx(value, rel=1e-4, abs=1e-5), name
    near = task.replace(goal=jnp.array([0.2, 0, 0]))
    bent = motion.replace(joint_pos=zero.at[0].set(3.0).at[1].set(4.0), lin_vel=jnp.zeros(3))
    got = env.rewards(near, bent, zero, zero, 280)
    assert float(got["position"]) == pytest.approx(0.9) and float(got["heading"]) == pytest.approx(0.8)
    assert float(got["stand"]) == pytest.approx(5.0) and float(got["wait"]) == 0.0
    beside = env.rewards(task.replace(goal=jnp.array([0.4, 0, 0])), bent, zero, zero, 280)
    assert float(beside["stand"]) == pytest.approx(5.0), "no way out at 0.26 m"
    assert float(env.rewards(task, bent, zero, zero, 280)["stand"]) == 0.0
    assert float(env.rewards(near, bent, zero, zero, 100)["stand"]) == 0.0
    early = env.rewards(task.replace(goal=jnp.array([0.4, 0, 0])), bent, zero, zero, 100)
    assert float(early["position"]) == 0.0 and float(early["wait"]) == 1.0
    assert set(env.config.weights) == set(got)


@pytest.mark.parametrize("level", [-1, 10])
def test_levels_that_do_not_exist_are_refused(level):
    with pytest.raises(ValueError, match=f"level {level} does not exist; choose 0 to 9"):
        envs.make("anymal_jump", "c", level=level)


def test_only_parkour_has_levels():
    levels = {task: family.LEVELS for task, (family, _) in envs.TASKS.items()}
    assert levels == {task: 10 * (task in SKILLS) for task in envs.TASKS}
    assert all(hasattr(family, "at_level") == (family.LEVELS > 0) for family, _ in envs.TASKS.values())


# --- pedipulation ---


def test_pedipulation_target_and_error(jitted):
    """The observed point is R^T (p - base), and the error the distance of the right front foot."""
    task = jitted("anymal_pedipulation", noise=0.0)
    env, state = task.env, task.start(8)
    for i in range(20):
        state = task.act(state, i)
    p = jax.device_get(state.physics)
    for n in range(8):
        data = mujoco.MjData(env.model)
        data.qpos[:] = p.qpos[n]
        mujoco.mj_forward(env.model, data)
        point = np.asarray(state.task.point[n])
        np.testing.assert_allclose(
            state.obs[n, -3:], data.body("base").xmat.reshape(3, 3).T @ (point - p.qpos[n, :3]), atol=1e-4
        )
        if not state.terminated[n]:
            distance = np.linalg.norm(data.site("RF_foot").xpos - point)
            assert float(state.metrics["foot_error"][n]) == pytest.approx(distance, abs=1e-4)


def test_pedipulation_points_fill_the_box_and_change_after_six_seconds(jitted):
    task = jitted("anymal_pedipulation", noise=0.0)
    points = np.asarray(jax.vmap(task.env.draw_point)(jax.random.split(jax.random.key(0), 400)))
    for axis, (low, high) in enumerate(task.env.config.box):
        assert low <= points[:, axis].min() < low + 0.05 and high - 0.05 < points[:, axis].max() <= high
    assert task.env.command_steps == 300 and task.env.episode_steps == 600
    state = task.start(8)
    late = state.replace(clock=jnp.full(8, 299))
    assert not np.allclose(task.hold(late).task.point, state.task.point)
    assert np.allclose(task.hold(state).task.point, state.task.point)


@pytest.fixture(scope="module")
def pedipulation(jitted):
    """anymal_pedipulation and one start."""
    task = jitted("anymal_pedipulation", noise=0.0)
    return task.env, jax.tree.map(lambda x: x[0], task.start(8))


def test_pedipulation_rewards_by_hand(pedipulation):
    env, state = pedipulation
    zero = jnp.zeros(12)
    motion = env.motion(state.physics)
    feet = jnp.zeros((4, 3)).at[1].set(jnp.array([0.3, 0.0, 0.4]))
    motion = motion.replace(
        foot_pos=feet,
        torque=zero.at[0].set(3.0),
        joint_acc=zero.at[1].set(5.0),
        joint_vel=zero.at[2].set(2.0),
        sensors=jnp.zeros_like(motion.sensors)
        .at[env.collision_sensors[0, 2]]
        .set(4.0)
        .at[env.collision_sensors[-1, 0]]
        .set(2.0),
    )
    got = env.rewards(state.task.replace(point=jnp.zeros(3)), motion, zero.at[0].set(0.5), zero, 0)
    want = {"torque": 9.0, "joint_acc": 25.0, "joint_vel": 4.0, "action_rate": 0.25, "collision": 2.0}
    want["foot_tracking"] = np.exp(-0.5 / 0.8)
    assert {name: float(value) for name, value in got.items()} == pytest.approx(want, rel=1e-5)


def test_pedipulation_has_no_mirror(jitted):
    assert jitted("anymal_pedipulation", noise=0.0).env.mirrors == {}


def test_pedipulation_starts_where_its_points_are_drawn():
    with pytest.raises(ValueError, match="spawn_xy and spawn_yaw must be 0"):
        envs.make("anymal_pedipulation", "c", spawn_xy=0.5)


def test_pedipulation_is_disturbed(jitted):
    """Constant forces on all shanks; at a push one on the pointing leg's, and a jump of all six velocities."""
    env, p = jitted("anymal_pedipulation", noise=0.0).env, jitted("anymal_pedipulation", noise=0.0).start(8).physics
    shanks = [env.model.site(foot).bodyid[0] for foot in env.robot.feet]
    wrench = np.array(p.wrench)
    assert 0 <= wrench[:, shanks, :3].min() < 1 and 11 < wrench[:, shanks, :3].max() <= 12
    wrench[:, shanks, :3] = 0
    assert not wrench.any()
    push, keys = jax.jit(jax.vmap(env.push, (0, 0, None, None))), jax.random.split(jax.random.key(0), 8)
    (quiet, _), (pushed, later) = push(keys, p, 10, 11), push(keys, p, 10, 10)
    jax.tree.map(np.testing.assert_array_equal, quiet, p)
    jump = np.abs(np.asarray(pushed.qvel - p.qvel))
    assert jump[:, :6].max(0).min() > 0.1 and jump.max() <= 0.5 + 1e-6 and not jump[:, 6:].any()
    assert later.min() >= 110 and later.max() <= 210
    changed = np.flatnonzero(np.asarray(pushed.wrench != p.wrench).any((0, 2)))
    assert changed.tolist() == [env.model.site("RF_foot").bodyid[0]]
    assert 10 < np.abs(pushed.wrench[:, changed[0], :3]).max() <= 20


def test_same_observation_layout_across_skills():
    """A policy of one skill is refused where the observation differs (crouch sees a ceiling)."""
    sizes = {task: envs.make(task, "c").obs_dim for task in SKILLS}
    assert sizes.pop("anymal_crouch") == 348 and set(sizes.values()) == {282}


def test_engines_agree_on_a_slab(started):
    """A robot that stands on the box it will climb down from: both engines hold it up at the same place."""
    _, state = started("anymal_climb_down")
    on_box = np.array([i for i in range(4, N, 10) if not state.task.rough[i]])  # level 4
    start = jax.tree.map(lambda x: x[on_box], state.physics)
    start, places = start.replace(qvel=jnp.zeros_like(start.qvel)), {}
    for engine in ("c", "mjx"):
        env = envs.make("anymal_climb_down", engine)
        physics, step = start, jax.jit(jax.vmap(env.engine.step))
        for _ in range(10):
            physics = step(physics, jnp.broadcast_to(env.default_pose, (len(on_box), 12)))
        places[engine] = np.asarray(physics.qpos[:, :3])
    np.testing.assert_allclose(places["c"], places["mjx"], atol=0.02)
    assert len(on_box) and (places["c"][:, 2] > 0.8).all(), "on the box of 0.5 m"
