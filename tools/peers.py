"""PPO of rsl_rl and of Brax, for bench.py to compare with. They need an environment of their own:

    python3 -m venv .peers
    .peers/bin/pip install -r requirements.txt -r requirements-peers.txt
    .venv/bin/python tools/bench.py --parts peers --peers .peers/bin/python

rsl_rl      its PPO in PyTorch on our go1_loco: the same physics, rewards, networks and minibatches
playground  MuJoCo Playground's Go1JoystickFlatTerrain on MJX with Brax PPO and Playground's own settings, but for
            num_envs environments. Its meshes, which are only drawn, are not in the package; tetrahedra replace them.
"""

import argparse
import json
import os
import struct
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))


def our_env(task, num_envs):
    """Our task as a VecEnv of rsl_rl. Arrays go to PyTorch and back, without a copy if possible."""
    import jax
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict

    import envs

    env = envs.make(task, "c")
    step = jax.jit(jax.vmap(env.step))

    class Vectorised(VecEnv):
        def __init__(self):
            self.num_envs, self.num_actions, self.max_episode_length = num_envs, env.action_dim, env.episode_steps
            self.device, self.cfg = "cpu", {}
            self.episode_length_buf = torch.zeros(num_envs, dtype=torch.long)
            self.state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))

        def get_observations(self):
            return TensorDict({"policy": torch.from_dlpack(self.state.obs)}, batch_size=[num_envs])

        def step(self, actions):
            self.state = step(self.state, jax.dlpack.from_dlpack(actions.detach().contiguous()))
            done = torch.from_dlpack(self.state.terminated | self.state.truncated).long()
            extras = {"time_outs": torch.from_dlpack(self.state.truncated)}
            return self.get_observations(), torch.from_dlpack(self.state.reward), done, extras

    return Vectorised()


def rsl_rl(task, num_envs, hidden, iterations):
    """Steps per second of rsl_rl's runner on our environment, after its first iterations."""
    from rsl_rl.runners import OnPolicyRunner

    network = {"class_name": "MLPModel", "hidden_dims": hidden, "activation": "elu"}
    config = {
        "num_steps_per_env": 24,
        "save_interval": 10**6,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
        "critic": dict(network),
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 5, "num_mini_batches": 4, "entropy_coef": 0.0},
    }
    runner = OnPolicyRunner(our_env(task, num_envs), config, log_dir=None, device="cpu")
    runner.learn(3)
    start = time.perf_counter()
    runner.learn(iterations)
    return num_envs * 24 * iterations / (time.perf_counter() - start)


def tetrahedron():
    """Four triangles as a binary STL file: 80 bytes of header, a count, and normal, corners and a word each."""
    corners = ((0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1))
    faces = [[(0, 0, 0), *(corners[i] for i in face)] for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    return bytes(80) + struct.pack("<I", 4) + b"".join(struct.pack("<12fH", *sum(face, ()), 0) for face in faces)


def playground(num_envs):
    """Steps per second of Brax PPO on Playground's Go1, by the median of six iterations, as the first ones compile."""
    import jax
    import numpy as np
    from brax.training.agents.ppo import networks, train
    from mujoco_playground import wrapper
    from mujoco_playground._src.locomotion.go1 import base, joystick
    from mujoco_playground.config import locomotion_params

    # Brax 0.14.2 calls a function that JAX 0.10 has removed; here it serves one device
    jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda x: jax.numpy.asarray(x)[None], tree)
    name = "Go1JoystickFlatTerrain"
    meshes = {f"{part}.stl": tetrahedron() for part in ("trunk", "hip", "thigh", "thigh_mirror", "calf")}
    get_assets = base.get_assets
    base.get_assets = lambda: get_assets() | meshes
    config = joystick.default_config()
    config.impl = "jax"
    env = joystick.Joystick(task="flat_terrain", config=config)
    ppo = dict(locomotion_params.brax_ppo_config(name, "jax"))
    factory = ppo.pop("network_factory")
    iteration = num_envs * ppo["unroll_length"]
    ppo |= {"num_envs": num_envs, "batch_size": num_envs // ppo["num_minibatches"]}
    ppo |= {"num_timesteps": 6 * iteration, "num_evals": 7}  # progress_fn is called at the end of each iteration
    ends = []
    train.train(
        env,
        network_factory=lambda *a, **k: networks.make_ppo_networks(*a, **k, **dict(factory)),
        wrap_env_fn=wrapper.wrap_for_brax_training,
        run_evals=False,
        progress_fn=lambda *_: ends.append(time.perf_counter()),
        **ppo,
    )
    times = np.diff(ends)
    print(times, file=sys.stderr)
    return iteration / np.median(times)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=("rsl_rl", "playground"))
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--hidden", type=int, nargs="+", default=[128, 128, 128])
    args = parser.parse_args()
    ours = args.peer == "rsl_rl"
    speed = rsl_rl("go1_loco", args.num_envs, args.hidden, 20) if ours else playground(args.num_envs)
    print(json.dumps({"steps/s": speed}))


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    main()
