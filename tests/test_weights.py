"""Weights, floors and thresholds of every task against numbers copied by hand from its source."""

import json
from pathlib import Path

import pytest

import envs

ROOT = Path(__file__).resolve().parent.parent

# Reward weights: term -> that of the source, or that and ours where ours differs (None: not a term there, or here).
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
        "track_lin_vel": (1.0, 3.0),
        "track_yaw_rate": (1.0, 3.0),
        "single_stance": (0.75, None),
        "in_step": (None, 1.5),
        "foot_path": (None, 1.0),
        "slip": (-0.1, -0.2),
        "impact": (None, -0.2),
        "joint_limits": -1.0,  # there of the ankles alone
        "hip_deviation": (-0.1, -0.2),
        "arm_deviation": -0.1,
        "waist_deviation": (-0.1, -0.5),
        "stand_still": (None, -0.05),
        "stand_on_feet": (None, -0.5),
        "vertical_vel": -0.2,
        "roll_pitch_rate": (-0.05, -0.0125),
        "orientation": -1.0,
        "action_rate": (-0.005, -0.0025),
        "joint_acc": -1e-7,
        "torque": -2e-6,
        "power": (None, -0.1),
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
    "on_feet": (None, 5.0),
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
OURS = {
    task: {term: value[1] if isinstance(value, tuple) else value for term, value in terms.items()}
    for task, terms in SOURCES.items()
}
WEIGHTS = EXPLORE | {
    task: {term: value for term, value in weights.items() if value is not None} for task, weights in OURS.items()
}
# (least reward per second, reward of a failure)
LIMITS = dict.fromkeys(SKILLS, (-20.0, -4.0)) | dict.fromkeys(EXPLORE, (-5.0, 0.0))
LIMITS |= {"anymal_loco": (-0.5, 0.0), "go1_loco": (-0.5, 0.0), "g1_loco": (-0.5, -2.0)}
LIMITS["anymal_pedipulation"] = (-0.5, -1.6)  # 80 a second there, and steps of 0.02 s

CONFIGS = {task: config for task, (_, config) in envs.TASKS.items()} | envs.EXPLORE
ROBUST = {task: config.robust["weights"] for task, config in CONFIGS.items() if "weights" in config.robust}
GROWN = {("g1_loco", term) for term in ("slip", "hip_deviation", "waist_deviation")}


def test_every_task_has_a_row():
    assert SOURCES.keys() == envs.TASKS.keys() and EXPLORE.keys() == envs.EXPLORE.keys()


@pytest.mark.parametrize("task", WEIGHTS)
def test_weights(task):
    config = CONFIGS[task]
    assert config.weights == WEIGHTS[task]
    assert (config.reward_floor, config.termination_reward) == LIMITS[task]


@pytest.mark.parametrize("task", SOURCES)
def test_a_weight_that_differs_keeps_its_sign_and_no_penalty_grows(task):
    """But for three of G1: its feet slid, its hips swung, and it can bow, which Isaac Lab's cannot."""
    for term, value in SOURCES[task].items():
        source, ours = value if isinstance(value, tuple) else (value, value)
        if None not in (source, ours):
            assert source * ours > 0, term
            assert (ours >= source) != ((task, term) in GROWN), term


def test_signs():
    """Eleven terms of all tasks are paid for, all others cost, in the robust sets as well."""
    paid = {term for weights in WEIGHTS.values() for term, weight in weights.items() if weight > 0}
    tracked = {"track_lin_vel", "track_yaw_rate", "foot_tracking", "position", "heading", "approach"}
    assert paid == tracked | {"air_time", "in_step", "foot_path", "on_feet", "alive"}
    for weights in [*(config.weights for config in CONFIGS.values()), *ROBUST.values()]:
        used = {term: weight for term, weight in weights.items() if weight}
        assert {term for term, weight in used.items() if weight > 0} == paid & used.keys()


def test_robust_sets_add_to_the_weights_of_their_task():
    """Each may weigh a term otherwise and add some, so that curves of both have the same columns and a few more."""
    assert ROBUST.keys() >= {"anymal_loco", "go1_loco"}
    for task, weights in ROBUST.items():
        assert CONFIGS[task].weights.keys() <= weights.keys()


@pytest.mark.parametrize("task", ROBUST)
def test_robust_sets_are_those_of_the_recorded_policies(task):
    name = CONFIGS[task].robot.removesuffix("_d")
    record = json.loads((ROOT / f"results/tasks/{name}_robust/args.json").read_text())
    assert record["config"]["robust"] == json.loads(json.dumps(CONFIGS[task].robust))


def test_thresholds():
    """Numbers within the terms; Isaac Lab counts flights from 0.5 s."""
    for task in ("anymal_loco", "go1_loco"):
        assert CONFIGS[task].air_time_threshold == 0.1
    assert {config.hasty for config in envs.EXPLORE.values()} == {0.2}
    assert [CONFIGS[skill].velocity_limit for skill in SKILLS] == [8.5] * 5
    assert [CONFIGS[skill].base_force for skill in SKILLS] == [1.0, 100.0, 1.0, 100.0, 1.0]
    assert [CONFIGS[skill].foot_force for skill in SKILLS] == [3000.0, 3000.0, 2000.0, 3000.0, 3000.0]
    assert [CONFIGS[skill].lowest_base for skill in SKILLS] == [-1e3, -1e3, -1e3, -1e3, -0.3]
