"""One run of a script: its environment, folders, rows, progress and how it stops.

Stage 3 may train several seeds, each in a folder. The scripts use it so:

    run = Run(args, env.config, iterations, SHOWN)
    (state,) = run.start(init)
    with run:
        while not run.done:
            state, metrics = train_chunk(state)
            run.log(state.iteration, [metrics])
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp

from envs import loader
from experiment import arguments, checkpoints, devices, figures, metrics, records
from experiment.progress import Progress


def make_env(make, name, args, **fields):
    """Build make(name, engine) with these fields of its config and then those of --set, or raise a UserError."""
    devices.find()
    try:
        env = make(name, args.engine, **fields | arguments.set_fields(args.set))
        devices.check_engine(env.engine)
        return env
    except (ValueError, ImportError) as error:
        raise records.UserError(str(error)) from None


class Run:
    """Folders and rows of one run. Of several processes only the first one writes."""

    def __init__(self, args, config, total, shown, over="env_steps"):
        """args and config are recorded in args.json; total: iterations of the run; for the rest see Progress."""
        self.args, self.config, self.total, self.shown, self.over = args, config, total, shown, over
        self.body = getattr(config, "body", {})  # of a robot from a file
        self.each_args = arguments.each_seed(args)
        self.folders = [Path(one.run_dir) if devices.is_first() else None for one in self.each_args]
        self.rows = [[] for _ in self.each_args]
        self.iteration, self.stopped = 0, False

    def start(self, init):
        """A state for each seed: `init(args)`, or with --resume the saved one. Then the run's folders are created.

        They come last: `init` may raise a UserError, which must leave an older run as it is.
        """
        print("  ".join(f"{name}={value}" for name, value in dataclasses.asdict(self.args).items()), flush=True)
        if self.body:
            print("\n".join(loader.lines(self.body)), flush=True)
        if self.args.resume:
            records.claim(self.args.resume)
            state, self.rows[0] = checkpoints.load_state(self.args.resume, jax.eval_shape(lambda: init(self.args)))
            self.iteration = int(self.rows[0][-1]["iteration"]) if self.rows[0] else 0
            if self.iteration > self.total:
                raise records.UserError(f"{self.args.resume} has more than {self.args.total_steps} steps already")
            if devices.is_first():
                arguments.extend(self.args)
            if self.done:
                print(f"{self.args.resume} has all its rows already; nothing is left to train")
            return [state]
        states = [init(one) for one in self.each_args]
        if devices.is_first():
            records.start_runs(self.each_args, self.config)
        return states

    def compile(self, function, *inputs):
        """Compile a jitted function for these inputs, and say how long it took."""
        start = time.perf_counter()
        function = function.lower(*inputs).compile()
        print(f"compiled in {time.perf_counter() - start:.1f} s", flush=True)
        return function

    def __enter__(self):
        """Start the clock and the progress. From here on Ctrl-C ends the run after a row."""
        self.last = self.saved = time.perf_counter()
        self.began = self.last - (self.rows[0][-1]["seconds"] if self.rows[0] else 0.0)
        board = self.args.run_dir if self.args.tensorboard and devices.is_first() else None
        self.progress = Progress(self.total, self.shown, self.over, board).__enter__()
        return self

    def __exit__(self, *error):
        self.progress.__exit__(*error)

    @property
    def done(self):
        """True once the run has made its iterations, or was asked to stop."""
        return self.iteration >= self.total or self.stopped

    @property
    def due(self):
        """True when it is time to save the state for --resume."""
        return self.last - self.saved >= 60 * self.args.save_minutes

    def seconds(self):
        """Training time so far [s], that before a resume included."""
        return time.perf_counter() - self.began

    def log(self, iteration, each_metrics):
        """Add a row for each seed, from its metrics (log_every,) up to this iteration."""
        pairs = zip(self.each_args, each_metrics, strict=True)
        self.add([metrics.make_row(args, int(iteration), self.seconds(), jax.device_get(one)) for args, one in pairs])

    def add(self, new):
        """Append one row for each seed to its metrics.csv, and show their mean."""
        before = self.rows[0][-1][self.over] if self.rows[0] else 0
        for rows, row, folder in zip(self.rows, new, self.folders, strict=True):
            rows.append(row)
            if folder:
                records.save_rows(folder / "metrics.csv", rows)
        now, work = time.perf_counter(), len(self.each_args) * (new[0][self.over] - before)
        self.progress.show(metrics.mean_row(new), work / (now - self.last))
        self.iteration, self.last = int(new[0]["iteration"]), now
        self.stopped = devices.any_process(self.progress.stopped)

    def save_policies(self, before, states):
        """Replace the policy.msgpack of each seed and, every save_minutes, save the states (S, ...).

        If weights are not finite, save the state `before` the last chunk and raise a UserError.
        """
        for args, folder, params in zip(self.each_args, self.folders, unstack(states.params), strict=True):
            if not checkpoints.finite(params):
                self.rows = [rows[:-1] for rows in self.rows]
                self.save(unstack(before))
                raise records.UserError(
                    f"weights are not finite after iteration {self.iteration}; lower --max-lr or --lr. "
                    f"To see what happened: python tools/replay.py {args.run_dir}"
                )
            if folder:
                meta = {"task": args.task, "args": dataclasses.asdict(args), "body": self.body}
                checkpoints.save(folder / "policy.msgpack", params, meta)
        if self.due:
            self.save(unstack(states))

    def save(self, states):
        """Write what --resume needs, a state for each seed. Skipped with several processes: none holds all."""
        if jax.process_count() == 1:
            for folder, state, rows in zip(self.folders, states, self.rows, strict=True):
                checkpoints.save_state(folder, state, rows)
        self.saved = time.perf_counter()

    def finish(self, states):
        """Save the states (S, ...), and draw the curves of each seed."""
        self.save(unstack(states))
        self.report_interrupt()
        for folder, rows in zip(self.folders, self.rows, strict=True) if devices.is_first() else ():
            figures.plot_training(rows, folder / "curve.png")
            print(f"wrote {folder}/policy.msgpack, metrics.csv, curve.png")

    def report_interrupt(self):
        """If the run was stopped, say how it can go on."""
        if self.stopped and jax.process_count() > 1:
            print("interrupted; runs of several processes save no state to go on from")
        elif self.stopped:
            print(f"interrupted; --resume {' or '.join(args.run_dir for args in self.each_args)} goes on from here")


def stack(trees):
    """A list of S pytrees of the same structure -> one with leaves (S, ...)."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def unstack(tree):
    """The inverse of `stack`."""
    count = len(jax.tree.leaves(tree)[0])
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(count)]
