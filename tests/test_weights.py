"""Weights, floors and thresholds of every task against numbers copied by hand from its source."""

import pytest

import envs

# Reward weights: term -> that of the source (None: not a term there), or that and ours where ours differs.
SOURCES = {
    "anymal_loco": {  # Isaac Lab, ANYmal D flat
        "track_lin_vel": 1.0,
        "track_yaw_rate": 0.5,
        "vertical_vel": -2.0,
        "roll_pitch_rate": (-0.05, -0.0125),
        "torque": (-2.5e-5, -6.25e-6),
        "joint_acc": (-2.5e-7, -6.25e-8),
        "action_rate": -0.01,
        "air_time": 0.5,
        "thigh_contact": -1.0,
        "orientation": -5.0,
        "slip": (None, -0.1),
        "pose": (None, -0.1),
        "alive": (None, 0.25),
    },
    "go1_loco": {  # Isaac Lab, Go1 flat
        "track_lin_vel": 1.5,
        "track_yaw_rate": 0.75,
        "vertical_vel": -2.0,
        "roll_pitch_rate": (-0.05, -0.0125),
        "torque": (-2e-4, -5e-5),
        "joint_acc": (-2.5e-7, -6.25e-8),
        "action_rate": -0.01,
        "air_time": (0.25, 1.0),
        "orientation": -2.5,
        "slip": (None, -0.1),
        "pose": (None, -0.1),
        "alive": (None, 0.25),
    },
    "g1_loco": {  # Isaac Lab, G1 flat
        "track_lin_vel": 1.0,
        "track_yaw_rate": 1.0,
        "single_stance": (0.75, 2.0),
        "one_foot": (None, 0.5),
        "air_time": (None, 1.0),
        "flight": (None, -1.0),
        "slip": -0.1,
        "ankle_limits": -1.0,
        "hip_deviation": -0.1,
        "arm_deviation": (-0.1, -0.05),
        "waist_deviation": (-0.1, -0.5),
        "vertical_vel": -0.2,
        "roll_pitch_rate": (-0.05, -0.0125),
        "orientation": -1.0,
        "action_rate": (-0.005, -0.0025),
        "joint_acc": -1e-7,
        "torque": -2e-6,
        "alive": (None, 0.5),
    },
    "anymal_pedipulation": {  # Arm et al., flat
        "foot_tracking": 15.0,
        "torque": -2e-5,
        "joint_acc": (-5e-6, -1.25e-6),
        "joint_vel": (-0.05, -0.0125),
        "action_rate": -0.01,
        "collision": -2.0,
    },
}
PARKOUR = {  # Hoeller et al.
    "position": 10.0,
    "heading": 5.0,
    "approach": (1.0, 3.0),
    "wait": -1.0,
    "stand": -0.5,
    "joint_vel": -0.001,
    "torque": -1e-5,
    "joint_vel_limit": -1.0,
    "torque_limit": (-0.2, -0.02),
    "base_acc": (-0.001, -0.0002),
    "feet_acc": (-0.002, -0.0004),
    "action_rate": (-0.01, -0.0025),  # of joint targets there, which are half the actions
    "feet_force": -1e-5,
    "collision": -1.0,
    "stumble": -1.0,
}
SKILLS = ("anymal_parkour_walk", "anymal_climb_up", "anymal_climb_down", "anymal_crouch", "anymal_jump")
SOURCES |= {skill: PARKOUR for skill in SKILLS}
SOURCES["anymal_climb_up"] = PARKOUR | {"collision": (-1.0, -0.2)}
EXPLORE = {  # regularisers of our own; nothing is published
    "anymal_d": {"action": -0.02, "action_rate": -0.005, "torque": -1e-5, "joint_vel": -5e-4, "hasty_steps": -0.5},
    "go1": {"action": -0.02, "action_rate": -0.005, "torque": -5e-5, "joint_vel": -2.5e-4, "hasty_steps": -0.5},
    "g1": {"action": -0.01, "action_rate": -0.002, "torque": -1e-5, "joint_vel": -2e-4, "hasty_steps": -0.5},
}
WEIGHTS = EXPLORE | {
    task: {term: value[1] if isinstance(value, tuple) else value for term, value in terms.items()}
    for task, terms in SOURCES.items()
}
# (least reward per second, reward of a failure)
LIMITS = dict.fromkeys(SKILLS, (-20.0, -4.0)) | dict.fromkeys(EXPLORE, (-5.0, 0.0))
LIMITS |= {"anymal_loco": (-0.5, 0.0), "go1_loco": (-0.5, 0.0), "g1_loco": (-0.5, -2.0)}
LIMITS["anymal_pedipulation"] = (-0.5, -1.6)  # 80 a second there, and steps of 0.02 s

CONFIGS = {task: config for task, (_, config) in envs.TASKS.items()} | envs.EXPLORE


def test_every_task_has_a_row():
    assert SOURCES.keys() == envs.TASKS.keys() and EXPLORE.keys() == envs.EXPLORE.keys()


@pytest.mark.parametrize("task", WEIGHTS)
def test_weights(task):
    config = CONFIGS[task]
    assert config.weights == WEIGHTS[task]
    assert (config.reward_floor, config.termination_reward) == LIMITS[task]


@pytest.mark.parametrize("task", SOURCES)
def test_a_weight_that_differs_keeps_its_sign_and_no_penalty_grows(task):
    """But for G1's waist: it can bow, which Isaac Lab's cannot."""
    for term, value in SOURCES[task].items():
        source, ours = value if isinstance(value, tuple) else (value, value)
        if source is not None:
            assert source * ours > 0, term
            assert ours >= source or (task, term) == ("g1_loco", "waist_deviation"), term


def test_signs():
    """Ten terms of all tasks are paid for, all others cost."""
    paid = {term for weights in WEIGHTS.values() for term, weight in weights.items() if weight > 0}
    tracked = {"track_lin_vel", "track_yaw_rate", "foot_tracking", "position", "heading", "approach"}
    assert paid == tracked | {"air_time", "single_stance", "one_foot", "alive"}
    for weights in (config.weights for config in CONFIGS.values()):
        assert {term for term, weight in weights.items() if weight > 0} == paid & weights.keys()


def test_thresholds():
    """Numbers within the terms; Isaac Lab counts flights from 0.5 s."""
    for task in ("anymal_loco", "go1_loco", "g1_loco"):
        assert CONFIGS[task].air_time_threshold == 0.1
    assert [config.hasty for config in envs.EXPLORE.values()] == [0.2] * 3
    assert [CONFIGS[skill].velocity_limit for skill in SKILLS] == [8.5] * 5
    assert [CONFIGS[skill].base_force for skill in SKILLS] == [1.0, 100.0, 1.0, 100.0, 1.0]
    assert [CONFIGS[skill].foot_force for skill in SKILLS] == [3000.0, 3000.0, 2000.0, 3000.0, 3000.0]
    assert [CONFIGS[skill].lowest_base for skill in SKILLS] == [-1e3, -1e3, -1e3, -1e3, -0.3]
