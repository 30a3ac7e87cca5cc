"""Progress of a run on the terminal and in TensorBoard, and the request to stop it."""

import signal
import sys

from experiment import records


class Progress:
    """A live bar on a terminal, else a line for each row. Ctrl-C and SIGTERM set `stopped`."""

    def __init__(self, total, shown, over="env_steps", board=None):
        """total: iterations of the run; shown: names of columns; over: the column that counts the work done.

        board: folder of TensorBoard's files, or None.
        """
        self.total, self.shown, self.over, self.bar, self.stopped = total, shown, over, None, False
        self.warned, self.board = False, records.tensorboard().SummaryWriter(str(board)) if board else None

    def stop(self, *_):
        self.stopped = True  # an exception could strike inside the physics callback

    def __enter__(self):
        self.handlers = {sign: signal.signal(sign, self.stop) for sign in (signal.SIGINT, signal.SIGTERM)}
        if sys.stdout and sys.stdout.isatty():
            from rich import progress as rich

            shown = rich.BarColumn(bar_width=20), rich.TextColumn("{task.percentage:.0f}%"), rich.TimeRemainingColumn()
            self.bar = rich.Progress(*shown, rich.TextColumn("{task.description}"))
            self.bar.start()
            self.task = self.bar.add_task("starting", total=self.total)
        return self

    def __exit__(self, *_):
        for sign, handler in self.handlers.items():
            signal.signal(sign, handler)
        if self.bar:
            self.bar.stop()
        if self.board:
            self.board.close()

    def show(self, row, speed):
        """Report a row, and `speed` in units of `over` per second."""
        if row.get("overflow") and not self.warned:
            self.warned = True
            print("warning: the engine had no room for some contacts; raise `contacts` in envs/engine.py")
        for name, value in row.items() if self.board else ():
            self.board.add_scalar(name, value, int(row[self.over]))
        text = records.line({name: row[name] for name in self.shown if name in row})
        text = f"{row[self.over] / 1e6:.2f}M {self.over.removeprefix('env_')}  {speed:,.0f}/s  {text}"
        if self.bar:
            self.bar.update(self.task, completed=row["iteration"], description=text)
        else:
            print(f"{row['seconds']:6.0f} s  {text}", flush=True)
