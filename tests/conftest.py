"""Environments are built and compiled once for the whole suite."""

import functools
import gc
import os
import re
import sys
from pathlib import Path

# Nearly all of the time of the tests is compilation: let the compiler try less hard, in the scripts they start as well.
FAST_COMPILER = (
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true --xla_cpu_use_fusion_emitters=false"
)
os.environ.setdefault("XLA_FLAGS", FAST_COMPILER)
gc.set_threshold(50_000, 20, 50)  # tracing makes many objects, and nearly all of them stay

import jax
import jax.numpy as jnp
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import envs
import pretrain_pidm
from experiment.run import Run

LATE = ("readme", "replay", "report", "resume", "rewards", "scripts", "sim_to_sim", "watch", "world")  # in the alphabet
LONG = tuple(f"test_{name}" for name in LATE)


def pytest_collection_modifyitems(items):
    """Long files begin, for a process that is left with one at the end keeps the others waiting."""
    items.sort(key=lambda item: item.path.stem not in LONG)


class Jitted:
    """A task with its reset and step vmapped and compiled; cfg overrides as in envs.make."""

    def __init__(self, task, engine="c", **overrides):
        self.env = envs.make(task, engine, **overrides)
        self.reset = jax.jit(jax.vmap(self.env.reset))
        self.step = jax.jit(jax.vmap(self.env.step))

    def start(self, num_envs, seed=0):
        return self.reset(jax.random.split(jax.random.key(seed), num_envs))

    def act(self, state, seed, std=0.5):
        shape = (state.reward.shape[0], self.env.action_dim)
        return self.step(state, std * jax.random.normal(jax.random.key(seed), shape))

    def hold(self, state):
        return self.step(state, jnp.zeros((state.reward.shape[0], self.env.action_dim)))


@pytest.fixture(scope="session")
def jitted():
    """jitted(task, **overrides) -> Jitted, cached."""
    return functools.cache(Jitted)


def compiled_at_its_calls(make, programs):
    """`make`, whose functions are compiled for each shape when they are called, but no program twice."""

    def made(args, env, *rest):
        function, found = make(args, env, *rest), {}
        if not hasattr(env, "config"):  # a stand-in
            return function

        def call(*inputs):
            shapes = tuple(jnp.shape(x) for x in jax.tree.leaves(inputs))
            if shapes not in found:
                lowered = function.lower(*inputs)
                key = make.__name__, repr(env.config), args.noise, lowered.as_text()
                found[shapes] = programs[key] = programs.get(key) or lowered.compile()
            return found[shapes](*inputs)

        return call

    return made


@pytest.fixture(scope="session", autouse=True)
def compiled_once():
    """Trainings whose program and environment are the same to the letter share one compilation."""
    programs = {}

    def compile(self, function, *inputs):
        lowered = function.lower(*inputs)
        text = re.sub(r"{index = \d+ : ui64}", "", lowered.as_text())  # the callback of engine c, which is the config's
        key = type(self.args), getattr(self.args, "task", None), repr(self.config), text
        if key not in programs:
            programs[key] = lowered.compile()
        return programs[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "compile", compile)
        for make in (pretrain_pidm.make_step, pretrain_pidm.make_predictor):
            patch.setattr(pretrain_pidm, make.__name__, compiled_at_its_calls(make, programs))
        yield


@pytest.fixture
def refused(capsys):
    """refused(main, args, *words): the script ends with exit code 2 and one line on stderr that holds these words."""

    def check(main, args, *words):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            main(args)
        err = capsys.readouterr().err
        assert stop.value.code == 2 and err.count("\n") == 1 and err.startswith("error: "), err
        for word in words:
            assert word in err, err

    return check
