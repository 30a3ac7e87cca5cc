"""Plant one fault at a time in a copy of the repository, and see whether the tests that must notice it do.

    python tools/mutants.py
    python tools/mutants.py --only gae
    python tools/mutants.py --list

A fault is a name, a text of its file that occurs once, and what stands there instead. Its tests must pass without it
and fail with it. Exit code 1 if more than one fault in twenty lives, 2 if one no longer fits the code.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent
PARTS = ("envs", "experiment", "assets", "tests", "tools", "docs")  # of the repository, beside the scripts
EARLY = (  # an ensemble that has learned from the rollout
    "measure_novelty(member, retrain(args, member, member_opt, state.ensemble, jax.tree.map(lambda x: x.reshape("
    "-1, *x.shape[2:]), transitions), args.num_steps * args.num_envs, k_retrain)[0], transitions)"
)
FAULTS = {  # (file, tests, words for -k) -> faults: name, old text, new text
    ("ppo_finetune.py", "test_reference", "stage_three and pidm"): [
        ("time limits are failures", "roll.reward + roll.bootstrap", "roll.reward"),
        ("the bootstrap is not discounted", "bootstrap = args.gamma * final_value", "bootstrap = final_value"),
        ("the bootstrap is for failures", "(env_state.truncated if env", "(env_state.terminated if env"),
        ("V(final_obs) with the next history", "final_obs, env_state.final_history", "final_obs, env_state.history"),
        (
            "V(final_obs) of the next episode",
            "_state.final_obs, env_state.final_history",
            "_state.obs, env_state.history",
        ),
        (
            "last value of final_obs",
            "(env_state.obs, env_state.history), m",
            "(env_state.final_obs, env_state.final_history), m",
        ),
        ("gae: values go on after an end", "next_value * (1 - done) - value", "next_value - value"),
        ("gae: advantages go on after an end", "gae_lambda * (1 - done) * advantage", "gae_lambda * advantage"),
        ("gae: no lambda", "args.gamma * args.gae_lambda *", "args.gamma *"),
        ("advantages not normalised", "(advantage - advantage.mean()) /", "advantage + 0.0 *"),
        ("advantages not centred", "(advantage - advantage.mean()) /", "advantage /"),
        ("advantages of other samples", "k_perm, (roll, advantage, ret))", "k_perm, (roll, advantage[:, ::-1], ret))"),
        (
            "the same order in each epoch",
            "_perm, k_mirror = jax.random.split(key)",
            "_perm, k_mirror = jax.random.key(0), key",
        ),
        ("one epoch less", "jax.random.split(key, args.num_epochs))", "jax.random.split(key, args.num_epochs)[1:])"),
        ("gradients not clipped", 'grads, (losses["actor_grad_norm"]', '_, (losses["actor_grad_norm"]'),
        ("gradients clipped together", "optax.tree.norm(part) for part in", "optax.tree.norm(grads) for part in"),
        ("mirror loss of the wrong sign", "loss += args.mirror_coef", "loss -= args.mirror_coef"),
        ("mirror target with a gradient", "jax.lax.stop_gradient(mean)[:", "mean[:"),
        ("one mirror only", "jax.random.randint(key, (), 0, len(env.mirrors))", "0"),
        ("KL from the new std alone", "(roll.mean, log_std_old, mean, log_std)", "(roll.mean, log_std, mean, log_std)"),
        ("KL reversed", "(roll.mean, log_std_old, mean, log_std)", "(mean, log_std, roll.mean, log_std_old)"),
        ("step size of the start", "lambda p, u: p - lr * u", "lambda p, u: p - args.lr * u"),
        ("the step size never falls", "jnp.maximum(lr / 1.5, 1e-5), lr)", "lr, lr)"),
        ("ratio not clipped", "jnp.minimum(ratio * advantage, clipped * advantage)", "(ratio * advantage)"),
        ("value not clipped", "(value_clipped - ret) ** 2).mean()", "(value - ret) ** 2).mean()"),
        ("entropy costs", "- args.entropy_coef * entropy", "+ args.entropy_coef * entropy"),
        ("the critic sees no history", "self.critic(self.history(inputs)", "self.critic(0 * self.history(inputs)"),
        ("the synthesizer sees no intention", "[z, z_intention], -1))", "[z, 0 * z_intention], -1))"),
    ],
    ("ppo_explore.py", "test_reference", "stage_one"): [
        ("stage 1: time limits are failures", "gae(args, reward + roll.bootstrap,", "gae(args, reward,"),
        ("no disagreement in the reward", "env.dt * novelty / ensemble.scale", "env.dt * 0"),
        ("disagreement not per second", "* env.dt * novelty", "* novelty"),
        ("the ensemble learns before it judges", "measure_novelty(member, state.ensemble, transitions)", EARLY),
        ("std in place of variance", "mean.var(0).mean(-1)", "mean.std(0).mean(-1)"),
        (
            "draws from the empty buffer",
            "jnp.minimum(state.iteration + 1, args.buffer_rollouts)",
            "args.buffer_rollouts",
        ),
        ("the ring buffer stays at its start", "state.iteration % args.buffer_rollouts * size", "0 * state.iteration"),
        ("likelihood without its log variance", "exp(-log_var) + log_var, (1, 2))", "exp(-log_var), (1, 2))"),
        ("change of state over a reset", 'after.final_history["prop"][:, -1] -', 'after.history["prop"][:, -1] -'),
        ("starts of episodes a step late", '"first": first[:-1]', '"first": first[1:]'),
    ],
    ("pretrain_pidm.py", "test_reference", "stage_two"): [
        ("augmentation without noise", "add_noise(k_noise, args.noise * noise_width(env), batch)", "batch"),
        ("noise above zero only", 'batch["prop"].shape, minval=-1.0)', 'batch["prop"].shape)'),
        ("padding with noise of its own", 'batch["pad"][:, None])', '0 * batch["pad"][:, None])'),
        (
            "L2",
            'jnp.abs(predict(net, variables, batch) - batch["action"])',
            'optax.l2_loss(predict(net, variables, batch), batch["action"])',
        ),
        ("a quarter is mirrored", "jax.random.bernoulli(k_one, 0.5,", "jax.random.bernoulli(k_one, 0.25,"),
        ("actions are not mirrored", '"next_x": "prop", "action": "action"}', '"next_x": "prop"}'),
        ("change of state from the oldest one", '- batch["prop"][:, -1]', '- batch["prop"][:, 0]'),
    ],
    ("pretrain_pidm.py", "test_pidm", "training_environments_alone"): [
        ("validation by training data", "data, data.validation)", "data, data.train)"),
        ("best epoch by training data", "permutation(data.validation)", "permutation(data.train)"),
    ],
    ("pretrain_pidm.py", "test_pidm", "patience_ends"): [
        ("the last epoch is validated", "env, best, data, folder)", "env, state[0], data, folder)"),
    ],
    ("pretrain_pidm.py", "test_pidm", "noise_of_its_own"): [
        ("one order for all epochs", "default_rng((args.seed, epoch))", "default_rng(args.seed)"),
        ("one noise for an epoch's batches", ", epoch), number)", ", epoch), 0)"),
    ],
    ("pretrain_pidm.py", "test_pidm", "not_finite_saves"): [
        ("weights that broke last are saved", 'np.isfinite(loss + row["error"])', "np.isfinite(loss)"),
    ],
    ("ppo_explore.py", "test_resume", "every_iteration"): [
        (
            "chunks overwrite each other",
            "array[run.iteration : run.iteration + args.log_every]",
            "array[: args.log_every]",
        ),
    ],
    ("ppo_explore.py", "test_reference", "adam_of"): [
        ("the ensemble has PPO's step size", "optax.adam(args.ensemble_lr)", "optax.adam(args.lr)"),
    ],
    ("ppo_finetune.py", "test_reference", "adam_of"): [
        ("another epsilon", "optax.scale_by_adam()", "optax.scale_by_adam(eps=1e-5)"),
    ],
    ("play.py", "test_scripts", "first_episodes_at"): [
        ("later falls count", "ended, alive & env_state.terminated, qpos)", "ended, env_state.terminated, qpos)"),
    ],
    ("play.py", "test_scripts", "level_by_level"): [
        ("evaluated on rough tiles", "fields = getattr(family, kind) | fields", "fields = fields"),
        ("the showcase has one level", 'fields["level"] = args.level', "pass"),
    ],
    ("envs/courses.py", "test_parkour", "goals_lie"): [
        ("a goal before the gap", "x + width + uniform(k_gx, 1.0, 1.5)", "x - uniform(k_gx, 0.1, 0.5)"),
    ],
    ("envs/pedipulation.py", "test_parkour", "is_disturbed"): [
        ("no constant force", "at[self.shanks, :3].set(force)", "at[self.shanks, :3].set(0 * force)"),
        ("forces change between pushes", "where(clock >= push_at, force", "where(clock < push_at, force"),
    ],
    ("envs/base.py", "test_parkour", "is_disturbed"): [
        ("pushes of two axes", "axes = self.config.push_axes", "axes = 2"),
    ],
    ("envs/base.py", "test_scripts", "first_clocks"): [
        ("a first push at once", "push_at=clock + self.push_interval(k_push)", "push_at=self.push_interval(k_push)"),
    ],
    ("envs/locomotion.py", "test_weights", "recorded_policies"): [
        ("a weak price for crouching", '"height": -30.0,', '"height": -3.0,'),
    ],
    ("experiment/progress.py", "test_metrics", "there_is_a_bar"): [
        ("a bar that stands", 'completed=row["iteration"]', "completed=0"),
    ],
    ("envs/locomotion.py", "test_weights", ""): [
        ("a penalty that pays", '"action_rate": -0.0025,', '"action_rate": 0.0025,'),
    ],
    ("envs/engine.py", "test_rewards", "rollout and go1_loco"): [
        ("damping that drives", "qfrc_actuator[6:] - self", "qfrc_actuator[6:] + self"),
    ],
    ("envs/engine.py", "test_rewards", "rollout and anymal_loco"): [
        ("masses as they were", "m.body_mass * mass_scale,", "m.body_mass * (1 + 0 * mass_scale),"),
    ],
    ("envs/base.py", "test_rewards", "rollout and go1_loco"): [
        ("an air clock that never resets", "jnp.where(contact, 0.0, self.air_time + dt)", "self.air_time + dt"),
        ("a flight that lands all the time", "jnp.where(contact, self.air_time, 0.0)", "self.air_time"),
        ("contact from 30 N on", "axis=-1) > self.touch,", "axis=-1) > 30.0,"),
        ("a floor for each step", "self.config.reward_floor * self.dt", "self.config.reward_floor"),
    ],
    ("envs/base.py", "test_rewards", "rollout and g1_loco"): [
        ("a fall costs nothing", "self.config.termination_reward * terminated", "0.0"),
    ],
    ("envs/base.py", "test_rewards", "last_step"): [
        ("a fall in the last step is a time limit", "self.episode_steps) & ~terminated", "self.episode_steps)"),
    ],
    ("envs/base.py", "test_envs", "noise_has"): [
        ("no noise", "true + uniform(key_one, -width, width, true.shape)", "true"),
    ],
    ("envs/base.py", "test_envs", "failure_resets"): [
        ("a reset keeps the old history", "stepped).replace(", "stepped).replace(history=stepped.history,"),
    ],
    ("envs/base.py", "test_envs", "padded_then"): [
        ("a history that forgets the last action", "action[None]])[1:]", "action[None]])[:-1]"),
    ],
    ("envs/base.py", "test_envs", "motion_is and go1"): [
        ("velocities in a frame turned twice", "down = inverse(quat)", "down = quat"),
    ],
    ("envs/rewards.py", "test_rewards", "rollout and go1_loco"): [
        ("slip in the air", "axis=-1) * contact)", "axis=-1))"),
    ],
    ("envs/rewards.py", "test_rewards", "rollout and go1 and not loco"): [
        ("long flights are hasty", "jnp.maximum(threshold - landed_after", "jnp.maximum(landed_after - threshold"),
    ],
    ("envs/rotations.py", "test_envs", "follows_the_heading"): [
        ("angles from 0 to 2 pi", "% (2 * jnp.pi) - jnp.pi", "% (2 * jnp.pi)"),
        ("yaw of the wrong sign", "return jnp.arctan2(2", "return -jnp.arctan2(2"),
    ],
    ("envs/rotations.py", "test_rewards", "rollout and g1_loco"): [
        ("yaw of a level robot alone", "2 * (w * z + x * y)", "2 * (w * z - x * y)"),
    ],
    ("envs/anatomy.py", "test_models", "mirrored_dynamics and go1"): [
        ("a mirror that keeps all signs", "signs.append(int(np.sign(along)))", "signs.append(1)"),
    ],
    ("envs/locomotion.py", "test_envs", "changes_when_due"): [
        ("a command for ever", "select(task.remaining <= 0,", "select(False,"),
    ],
    ("envs/locomotion.py", "test_envs", "that_was_set"): [
        ("a command that was set expires", "remaining=forever", "remaining=task.remaining"),
        ("a command that was set is steered", "steers=~yes", "steers=task.steers"),
    ],
    ("envs/locomotion.py", "test_envs", "shares_and_ranges"): [
        ("who turns on the spot walks", "jnp.where(on_the_spot, 0.0, velocity)", "velocity"),
        ("turns on the spot count as turns", "kind >= c.on_the_spot + c.turning", "kind >= c.turning"),
    ],
    ("envs/locomotion.py", "test_envs", "not_steered"): [
        ("a heading steers every command", "jnp.where(task.steers, turn, task.command[2])", "turn"),
    ],
    ("envs/locomotion.py", "test_envs", "low_passed"): [
        ("no low-pass", "task.velocity + share * (", "self.tracked_velocity(motion) + 0 * ("),
        ("a low-pass of one second", "min(1.0, self.dt / self.config.tracking_seconds)", "self.dt"),
    ],
    ("envs/locomotion.py", "test_envs", "half_a_step_apart and g1"): [
        ("feet in one beat", "jnp.array(self.robot.gait)", "0 * jnp.array(self.robot.gait)"),
        ("a clock that asks who stands for steps", "(share >= swing) | ~moves", "(share >= swing)"),
    ],
    ("envs/locomotion.py", "test_envs", "next_reward"): [
        ("a phase while standing", "jnp.cos(angle)]) * self.paced(task.command)", "jnp.cos(angle)])"),
    ],
    ("envs/locomotion.py", "test_envs", "marching"): [
        ("a robot that never marches", "rewards.moving(command) | self.config.march", "rewards.moving(command)"),
    ],
    ("envs/rewards.py", "test_envs", "half_a_step_apart and g1"): [
        ("turning on the spot is standing", " | (jnp.abs(command[2]) > 0.1)", ""),
    ],
    ("envs/rewards.py", "test_rewards", "rollout and g1_loco"): [
        ("power that motors take is free", "jnp.abs(torque * joint_vel)", "jnp.maximum(torque * joint_vel, 0)"),
        ("impact of half the weight", "/ weight - 1.5,", "/ weight - 0.5,"),
        ("feet of any height", "/ 0.05**2)", "/ 0.5**2)"),
        ("both feet or none in step", "jnp.mean(contact == stance)", "jnp.all(contact == stance)"),
    ],
    ("envs/base.py", "test_envs", "late_actions"): [
        ("actions are never late", "self.action_scale * mixed", "self.action_scale * action"),
        ("delays in whole steps", "(1 - older) * actions[whole] + older * actions[whole + 1]", "actions[whole]"),
        ("delays from the oldest action", "action[None]])[::-1]", "action[None]])"),
    ],
    ("envs/base.py", "test_envs", "late_readings"): [
        ("readings are never late", "now + state.lag * (state.readings[name] - now)", "now"),
        ("readings as late as the episode", "readings=readings,", "readings=state.readings,"),
    ],
    ("envs/base.py", "test_envs", "drawn_in_their"): [
        (
            "one strength for all motors",
            "*c.motor_strength, (self.action_dim,))",
            "*c.motor_strength) * jnp.ones(self.action_dim)",
        ),
        ("delays in seconds", "*self.config.action_delay) / self.dt", "*self.config.action_delay)"),
    ],
    ("envs/base.py", "test_envs", "seen_mirrored and g1"): [
        ("a mirror image in the same beat", '"phase": np.array([-1, -1])', '"phase": np.array([1, 1])'),
    ],
    ("envs/engine.py", "test_envs", "weak_motors"): [
        ("motors of one strength", "m.actuator_gainprm * strength[", "m.actuator_gainprm + 0 * strength["),
        ("a weak motor's other zero", "m.actuator_biasprm * strength[", "m.actuator_biasprm + 0 * strength["),
    ],
    ("envs/engine.py", "test_envs", "friction_is_that"): [
        (
            "joints that never rub",
            "xp.maximum(joint_friction[..., None], 1e-6)",
            "1e-6 + 0 * joint_friction[..., None]",
        ),
    ],
    ("envs/engine.py", "test_envs", "reach_the_engine and mjx"): [
        ("joints without friction held", "xp.maximum(joint_friction[..., None], 1e-6)", "joint_friction[..., None]"),
    ],
    ("envs/loader.py", "test_envs", "joint_by_joint"): [
        ("one scale for all joints", "np.round(np.minimum(0.25 * limits / kp, 0.5), 3)", "np.full(len(names), 0.5)"),
    ],
    ("envs/__init__.py", "test_scripts", "cannot_be_set"): [
        ("any text turns --robust on", "if not isinstance(robust, bool):", "if False:"),
    ],
    ("ppo_finetune.py", "test_scripts", "set_reaches"): [
        ("--robust is not heard", "robust=args.robust, robot", "robot"),
    ],
    ("play.py", "test_scripts", "set_reaches"): [
        ("a policy forgets its robust set", 'robust=meta["args"].get("robust", False)', "robust=False"),
    ],
    ("tools/play_onnx.py", "test_envs", "next_reward"): [
        ("a robot's clock that stands", "np.sin(angle), np.cos(angle)", "0, 1"),
    ],
    ("envs/parkour.py", "test_parkour", "promotion"): [
        ("a level is never lost", "task.level + success - failure", "task.level + success"),
    ],
    ("envs/parkour.py", "test_parkour", "success_is_to_stand"): [
        ("success nose-down", "upright = self.tilt(motion) < UPRIGHT_TILT", "upright = True"),
        (
            "height above the floor, not the box",
            "motion.base_pos[2] - self.ground_height(",
            "motion.base_pos[2] - 0 * self.ground_height(",
        ),
    ],
    ("envs/parkour.py", "test_parkour", "starts_again_at_a_touch"): [
        ("knees may touch", "jnp.where(self.touching_parts(motion) > 0, 0,", "jnp.where(False, 0,"),
    ],
    ("envs/parkour.py", "test_parkour", "parkour_rewards"): [
        ("a stand term that is avoided at 0.26 m", '"stand": at_goal', '"stand": (distance < 0.25)'),
    ],
    ("envs/pedipulation.py", "test_parkour", "pedipulation_target"): [
        ("a point seen from a frame turned twice", "inverse(motion.quat), task.point", "motion.quat, task.point"),
    ],
    ("experiment/devices.py", "test_world", "pieces"): [
        ("pieces are summed", "lambda x: x / count, jax", "lambda x: x, jax"),
        ("a batch is never split", "while alone and size", "while False and size"),
    ],
    ("experiment/devices.py", "test_reference", "stage_three and 8"): [
        (
            "each piece counts twice",
            "jnp.add, total, function(piece))",
            "lambda a, b: a + 2 * b, total, function(piece))",
        ),
    ],
    ("envs/base.py", "test_rewards", "bodies_on_the_ground and g1"): [
        ("half of the bodies may touch the ground", "jnp.any(force > self.touch)", "jnp.any(force[::2] > self.touch)"),
    ],
    ("envs/explore.py", "test_explore", "explorers_are_pushed"): [
        ("explorers are never pushed", "physics, push_at = super().push(", "_, push_at = super().push("),
    ],
    ("envs/courses.py", "test_parkour", "levels_are"): [
        ("stairs only go up", "uniform(k_up, 0.0, 1.0) < 0.5", "uniform(k_up, 0.0, 1.0) < 1.5"),
    ],
    ("experiment/walks.py", "test_gait", "push_is_of"): [
        ("a push of nothing", "PUSH * np.stack", "0 * PUSH * np.stack"),
    ],
    ("play.py", "test_world", "gains_of"): [
        ("a robot gets wrong gains", "env.model.dof_damping[6:]", "env.model.dof_armature[6:]"),
    ],
    ("ppo_explore.py", "test_explore", "shipped_data"): [
        ("one environment validates", "round(args.validation * args.num_envs)", "round(args.validation)"),
    ],
    ("experiment/records.py", "test_metrics", "two_seeds"): [
        ("the last row is not saved", "writer.writerows(rows)", "writer.writerows(rows[:-1])"),
    ],
    ("experiment/records.py", "test_world", "disk_that_fills"): [
        ("files written in place", 'path.with_name(path.name + ".tmp")', "path"),
    ],
    ("experiment/arguments.py", "test_resume", "another_version and finetune"): [
        ("arguments that are missing are filled in", "sorted(names ^ {", "sorted(names - {"),
    ],
    ("experiment/metrics.py", "test_metrics", "a_row_is"): [
        ("episodes averaged over all steps", "value / max(episodes, 1)", "value / (args.num_envs * args.num_steps)"),
        ("sums become means", "value.sum() if name.startswith(SUM) else value.mean()", "value.mean()"),
        ("episodes that go on count", "jnp.sum(metrics.pop(name) * done)", "jnp.sum(metrics.pop(name))"),
    ],
    ("experiment/run.py", "test_scripts", "same_seed"): [
        ("seeds in the reverse order", "for i in range(count)]", "for i in reversed(range(count))]"),
    ],
    ("experiment/run.py", "test_metrics", "two_seeds"): [
        ("states saved every few seconds", "60 * self.args.save_minutes", "self.args.save_minutes"),
    ],
    ("experiment/run.py", "test_metrics", "not_finite"): [
        ("weights that are not finite are saved", "if not checkpoints.finite(params):", "if False:"),
    ],
}


@dataclass
class Args:
    only: str = ""  # rows whose text has this
    list: bool = False  # print the rows alone


def copy_repository(folder):
    """Make a copy to plant faults in. Recorded runs are linked, for no fault is planted there."""
    for name in PARTS:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.glob("*.*"):
        if path.is_file():
            shutil.copy(path, folder)
    (folder / "results").symlink_to(ROOT / "results")


def fail(text):
    """Print an error and exit."""
    print(f"error: {text}", file=sys.stderr)
    sys.exit(2)


def complaint(folder, file, words):
    """First line of why one of these tests fails in a copy; empty if all pass."""
    # Bytecode is looked up by time and size of its source, which a fault may leave as they were.
    env = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"tests/{file}.py", "-k", words]
    run = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    if run.returncode not in (0, 1):  # no such test, or a fault that is no Python
        fail(f"tests/{file}.py -k '{words}' ends with {run.returncode}:\n{run.stdout[-800:]}{run.stderr[-800:]}")
    lines = [line[1:].strip() for line in run.stdout.splitlines() if line.startswith("E ")]
    return next(iter(lines), "no reason given") if run.returncode else ""


def death(folder, fault, sound):
    """Complaint of a fault's tests; empty if it lives. `sound` holds the tests known to pass without a fault."""
    _, old, new, file, *tests = fault
    if tests not in sound:
        if complaint(folder, *tests):
            fail(f"tests/{tests[0]}.py -k '{tests[1]}' fails without any fault")
        sound.append(tests)
    path = folder / file
    text = path.read_text()
    path.write_text(text.replace(old, new))
    try:
        return complaint(folder, *tests)
    finally:
        path.write_text(text)


def main(args):
    """Print who lives."""
    faults = [(*fault, *group) for group, faults in FAULTS.items() for fault in faults]
    for name, old, _, file, *_ in faults:
        count = (ROOT / file).read_text().count(old)
        if count != 1:
            fail(f"{name}: its text occurs {count} times in {file}")
    faults = [fault for fault in faults if args.only in " ".join(fault)]
    if not faults:
        fail(f"no fault has {args.only!r} in its name, file or tests; see --list")
    if args.list:
        print(
            *(f"{file}: {name} (tests/{tests}.py -k '{words}')" for name, _, _, file, tests, words in faults), sep="\n"
        )
        return
    alive, sound = [], []
    with tempfile.TemporaryDirectory() as folder:
        copy_repository(Path(folder))
        for fault in faults:
            start = time.perf_counter()
            why = death(Path(folder), fault, sound)
            alive += [] if why else [fault]
            seconds = time.perf_counter() - start
            print(f"{'dies ' if why else 'LIVES'} {seconds:4.0f} s  {fault[3]}: {fault[0]}  ({why[:60]})", flush=True)
    print(f"{len(faults) - len(alive)} of {len(faults)} die", *(f"lives: {fault[0]}" for fault in alive), sep="\n")
    sys.exit(20 * len(alive) > len(faults))


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__.split("\n")[0]))
