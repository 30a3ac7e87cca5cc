"""Run a trained policy: evaluate it, film it, watch and steer it, or export it for a robot.

    python play.py results/tasks/go1_loco/policy.msgpack --out runs/look
    python play.py results/tasks/go1_loco/policy.msgpack --video go1.gif
    python play.py results/tasks/anymal_climb_up/policy.msgpack --web --level 3
    python play.py results/tasks/go1_robust/policy.msgpack --export go1.onnx

By default it evaluates the mean action, and writes eval.json, rollout.png and rollout.gif beside the policy, or to
--out. The task stands in the policy file.
"""

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import envs
import ppo_finetune
from envs.locomotion import Locomotion
from experiment import arguments, checkpoints, gait, metrics, records, walks
from experiment.run import make_env


@dataclass(frozen=True)
class Args:
    """One policy, and at most one of --video, --viewer, --web and --export."""

    policy: tyro.conf.Positional[str]  # a policy.msgpack of ppo_finetune.py
    episodes: int = 64  # episodes of the evaluation, at each level where the task has levels
    level: int | None = None  # level of an obstacle course, 0 to 9; None: evaluate all, show level 4
    set: tuple[str, ...] = ()  # NAME=VALUE of the task's config, e.g. friction=0.3,0.3 noise=0
    engine: str = "auto"  # physics: c (CPU threads), mjx (accelerators), warp (NVIDIA)
    out: str | None = None  # folder of the evaluation's files; None: that of the policy
    video: str | None = None  # film a whole episode as this .gif or .mp4
    viewer: bool = False  # watch and steer the robot in a window
    web: bool = False  # watch and steer it in a browser
    host: str = "127.0.0.1"  # address that --web listens on; 0.0.0.0: all of this machine's
    port: int = 8080  # port that --web listens on
    export: str | None = None  # write the policy as this ONNX file


# --- Policy ---


def load_policy(path, engine="auto", overrides=(), **fields):
    """Build environment, network, parameters and meta from a policy file. UserError if it is none or does not fit.

    The environment has the --set of the training, then `fields` of its config, then `overrides` (NAME=VALUE).
    """
    params, meta = checkpoints.load(Path(path), "policy")
    trained = {name: meta["args"].get(name) for name in ("network", "init_std", "hidden", "intention")}
    args = ppo_finetune.Args(task=meta["task"], engine=engine, set=tuple(overrides), **trained)
    make = partial(envs.make, robust=meta["args"].get("robust", False), robot=meta.get("body"))
    env = make_env(make, args.task, args, **arguments.set_fields(meta["args"].get("set", ())) | fields)
    net = ppo_finetune.make_net(args, env)
    state = jax.eval_shape(env.reset, jax.random.key(0))
    like = jax.eval_shape(net.init, jax.random.key(0), net.inputs(state.obs, state.history))
    checkpoints.check_shapes(path, params, like)
    return env, net, params, meta


def load(args, kind="EVALUATION_FIELDS", **fields):
    """Load the policy for evaluation or, with SHOWCASE_FIELDS, for pictures. UserError if task or level is unknown."""
    _, meta = checkpoints.load(Path(args.policy), "policy")
    family = envs.family(meta["task"])
    if family is None:
        known = ", ".join(envs.TASKS | envs.OWN | envs.GENERIC)
        raise records.UserError(f"{args.policy} is a policy for {meta['task']!r}; known are {known}")
    if args.level is not None and not 0 <= args.level < family.LEVELS:
        known = f"choose 0 to {family.LEVELS - 1}" if family.LEVELS else "leave out --level"
        raise records.UserError(f"{meta['task']} has no level {args.level}; {known}")
    fields = getattr(family, kind) | fields
    if "level" in fields and args.level is not None:
        fields["level"] = args.level
    return load_policy(args.policy, args.engine, args.set, **fields)


def load_nominal(path, engine="auto", overrides=(), seconds=gait.SECONDS):
    """Load a policy for walks of so many seconds, which no episode ends, whatever the overrides say."""
    kept = [word for word in overrides if not word.startswith("episode_seconds=")]
    return load_policy(path, engine, kept, **walks.NOMINAL, episode_seconds=seconds + 1)


# --- Evaluation ---


def evaluate(env, net, params, episodes, level=None):
    """Run an episode per environment with the mean action, seed fixed. Metrics; start, qpos (steps, nq) of the first.

    Once the first episode is over, qpos repeats the pose before the step that ended it.
    """

    def step(carry, _):
        env_state, alive, qpos = carry
        action = net.apply(params, net.inputs(env_state.obs, env_state.history), method=net.mean)
        env_state = jax.vmap(env.step)(env_state, action)
        ended = alive & (env_state.terminated | env_state.truncated)
        qpos = jnp.where((alive & ~ended)[0], env_state.physics.qpos[0], qpos)
        return (env_state, alive & ~ended, qpos), (env_state.metrics, alive, ended, alive & env_state.terminated, qpos)

    curriculum = None if level is None else env.at_level(level)
    env_state = jax.vmap(partial(env.reset, curriculum=curriculum))(jax.random.split(jax.random.key(1), episodes))
    carry = env_state, jnp.ones(episodes, bool), env_state.physics.qpos[0]
    _, (report, alive, ended, fell, qpos) = jax.lax.scan(step, carry, None, env.episode_steps)
    result = metrics.of_first_episodes(report, alive, ended) | {"falls": fell.any(0).mean()}
    return result, jax.tree.map(lambda x: x[0], env_state), qpos


def title(env, meta):
    """Level, where the task has some, and method of a policy, for its pictures."""
    trained = meta["args"]
    loaded = trained.get("load_into", "both") if trained["pretrained"] else "none"
    names = {"both": "pretrained PIDM", "none": "random PIDM", "shuffled": "shuffled PIDM"}
    names |= {"none": "PIDM"} if trained.get("policy") else {}  # its first training is not known here
    pidm = names.get(loaded, f"PIDM, pretrained {loaded.replace('_', ' ')}")
    kind = "MLP" if trained["network"] == "mlp" else pidm
    return f"level {env.config.level}, {kind}" if env.LEVELS else kind


def run_evaluation(args):
    """Print and save metrics of the task on its usual commands and of the showcase; write pictures of the showcase."""
    from envs import render  # matplotlib and OpenGL are slow to load

    if not 1 <= args.episodes <= 100_000:
        raise records.UserError(f"--episodes must be from 1 to 100000, not {args.episodes}")
    env, net, params, meta = load(args)
    folder = Path(args.out or Path(args.policy).parent)
    folder.mkdir(parents=True, exist_ok=True)  # what cannot be written shows before the work
    levels = range(env.LEVELS) if args.level is None else [args.level]
    run = jax.jit(lambda params, level: evaluate(env, net, params, args.episodes, level)[0])
    report = {}
    for level in levels if env.LEVELS else [None]:
        name = "task" if level is None else f"level {level}"
        report[name] = run(params, level)
        print(f"{args.episodes} episodes of {meta['task']}, {name}, mean action:", records.line(report[name]))
    show, *_ = load(args, "SHOWCASE_FIELDS")
    shown, start, qpos = jax.jit(lambda params: evaluate(show, net, params, min(args.episodes, 16)))(params)
    fields = {name: getattr(show.config, name) for name in show.SHOWCASE_FIELDS}
    print(f"showcase {fields}:", records.line(shown))
    report = jax.tree.map(float, report | {"showcase": shown}) | {"showcase_config": fields}
    if isinstance(env, Locomotion):
        walker = load_nominal(args.policy, args.engine, args.set)[:3]
        by_command, report["gait"] = walks.evaluate(*walker, starts=min(max(args.episodes // 3, 1), 20))
        print(gait.lines(by_command, report["gait"]))
    records.replace_text(folder / "eval.json", json.dumps(report, indent=1) + "\n")
    shown_with = {"title": title(show, meta), "markers": show.markers(start.task)}
    for name, picture in render.film(show, qpos, start.physics, **shown_with, **show.FILM_WINDOW).items():
        records.replace_bytes(folder / name, picture)
        print(f"wrote {folder / name}")


# --- Films, viewers ---


def film(args):
    """Film the showcase from its first step to its last."""
    from envs import render

    path = Path(args.video)
    env, net, params, meta = load(args, "SHOWCASE_FIELDS")
    try:
        render.check_video(path)
        _, start, qpos = jax.jit(lambda params: evaluate(env, net, params, 1))(params)
        records.write(path, render.video(env, qpos, start.physics, path, title(env, meta), env.markers(start.task)))
    except ValueError as error:
        raise records.UserError(str(error)) from None
    print(f"wrote {path}")


def watch(args):
    """Let a person command and push the robot and pick the level, in a window or a browser; see tools/viewer.py."""
    from tools import viewer

    env, net, params, _ = load(args)
    if "time_left" not in env.OBS:
        env, *_ = load(args, episode_seconds=3600.0)  # no need to start again after 20 s

    def act(state):
        return net.apply(params, net.inputs(state.obs, state.history), method=net.mean)

    robot = viewer.Watched(env, act, args.level)
    return viewer.window(robot) if args.viewer else viewer.browser(robot, args.host, args.port)


# --- Export ---


def onboard(env, net, params):
    """The computation of one control step on a robot, as a function of arrays without batch axis, and their shapes.

    In: the observation's blocks in SI units (joint_pos [rad] is absolute; no `action`), prop_history (K, X) and
    action_history (K, A), oldest first. Out: action (A,), joint_target (A,) [rad] for the PD loops, and both
    histories for the next step. An episode starts with K copies of its first x_t and with actions of 0.
    """
    shapes = {name: (env.width(kind),) for name, (kind, _) in env.OBS.items() if name != "action"}
    shapes |= {"prop_history": (env.config.history, env.prop_dim)}
    shapes |= {"action_history": (env.config.history, env.action_dim)}

    def policy(*arrays):
        given = dict(zip(shapes, arrays, strict=True))
        past = given["action_history"]
        given |= {"joint_pos": given["joint_pos"] - env.default_pose, "action": past[-1]}
        prop = jnp.concatenate([given[name] for name in env.prop_layout])
        history = {"prop": jnp.concatenate([given["prop_history"], prop[None]]), "action": past}
        inputs = net.inputs(env.pack(given), history)
        action = net.apply(params, jax.tree.map(lambda x: x[None], inputs), method=net.mean)[0]
        target = env.default_pose + env.action_scale * action
        return action, target, history["prop"][1:], jnp.concatenate([past, action[None]])[1:]

    return policy, shapes


def export_onnx(args):
    """Write the policy's mean action as an ONNX graph for one robot, batch 1, with the inputs and outputs of `onboard`.

    Metadata, each as JSON: see `facts` below. Every list follows the order of `joints`. Needs requirements-export.txt.
    """
    try:
        import jax2onnx
        import onnx
    except ImportError:
        raise records.UserError("--export needs jax2onnx: pip install -r requirements-export.txt") from None
    env, net, params, meta = load(args)
    policy, shapes = onboard(env, net, params)

    def batch_of_one(*arrays):  # jax2onnx 0.17 cannot export a vmapped flax layer
        return [x[None] for x in policy(*(x[0] for x in arrays))]

    inputs = [jax.ShapeDtypeStruct((1, *shape), jnp.float32) for shape in shapes.values()]
    outputs = ["action", "joint_target", "next_prop_history", "next_action_history"]
    model = jax2onnx.to_onnx(batch_of_one, inputs, input_names=[*shapes], output_names=outputs)
    facts = {
        "task": meta["task"],
        "robot": env.robot.name,
        "dt": env.dt,  # [s] control step
        "joints": list(env.robot.joints),
        "default_pose": np.asarray(env.default_pose).tolist(),  # [rad]
        "action_scale": list(env.robot.action_scale),  # [rad] a unit of action
        "kp": env.model.actuator_gainprm[:, 0].tolist(),  # [N m / rad]
        "kd": env.model.dof_damping[6:].tolist(),  # [N m s / rad]; the MJCF has it as damping of the joints
        "torque_limit": env.model.actuator_forcerange[:, 1].tolist(),  # [N m] bounds the kp part; damping comes on top
        "history": env.config.history,
        "prop": list(env.prop_layout),
        "joint_range": env.model.jnt_range[1:].tolist(),  # [rad]; joint_target is not clipped to it
        "command_ranges": env.COMMAND_RANGES,  # as trained
        "robust": meta["args"].get("robust", False),
        **({"mjcf": env.config.body["mjcf"]} if env.config.body else {}),  # of a robot from a file
        # of the input `phase`
        **({name: getattr(env.config, name) for name in ("gait_hz", "march")} if "phase" in shapes else {}),
        "versions": records.versions(),
        "trained_with": meta.get("versions"),
    }
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in facts.items()})
    records.write(Path(args.export), model.SerializeToString())
    print(f"wrote {args.export}" + ("" if facts["robust"] else "; trained without --robust: for simulation only"))


# --- Main ---


def main(args):
    """Do what the arguments ask for. User errors print one line and exit with code 2."""
    actions = {"video": film, "viewer": watch, "web": watch, "export": export_onnx}
    with records.one_line_errors():
        asked = [name for name in actions if getattr(args, name)]
        if len(asked) > 1:
            raise records.UserError(f"--{asked[0]} and --{asked[1]} exclude each other; leave one out")
        return actions[asked[0]](args) if asked else run_evaluation(args)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
