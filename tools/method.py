"""The method in one picture: explore, pretrain the PIDM, fine-tune with PPO, and the size of Go1's networks.

    python tools/method.py

Writes docs/method.png. Lengths are pixels of the picture, from its lower left corner.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrow, FancyBboxPatch, Rectangle

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import envs
from experiment import devices, figures, records

WIDTH, HEIGHT = 1600, 840
TEXT = 24  # 9 points where the picture is shown 800 pixels wide
CORE, NEW, ONCE, PLAIN = "#0072B2", "#F2B134", "#D5D9DE", "#FFFFFF"  # Okabe and Ito's blue and orange; greys
INK, PANEL = "#1F2933", "#F4F6F8"
INPUTS, ENCODERS, BACKBONE, ENDS, OUTPUTS = 682, 578, 430, 302, 188  # heights of rows


def thousands(params):
    """Number of parameters, as text."""
    return f"{sum(leaf.size for leaf in jax.tree.leaves(params)) / 1000:.1f} k"


def sizes():
    """Numbers of parameters {network: {part: text}} of Go1's networks, number of ensemble members, and K."""
    import ppo_explore
    import ppo_finetune
    import pretrain_pidm

    env, key = envs.make("go1_loco", "c"), jax.random.key(0)
    steps, x_dim, a_dim = env.config.history, env.prop_dim, env.action_dim
    inputs = jnp.zeros((steps + 1) * x_dim + steps * a_dim), jnp.zeros(x_dim)
    member = ppo_explore.PIDM(ppo_explore.MEMBER, 2 * a_dim)
    pidm = pretrain_pidm.PIDM(pretrain_pidm.SIZES["go1"], a_dim)
    args = ppo_finetune.merge(ppo_finetune.Args(task="go1_loco", network="pidm"), env.config.ppo)
    net = ppo_finetune.make_net(args, env)
    state = jax.eval_shape(env.reset, key)
    branches = jax.eval_shape(net.init, key, net.inputs(state.obs, state.history))["params"]
    parts = {"pidm": jax.eval_shape(pidm.init, key, *inputs)["params"], "actor": branches["actor"]}
    parts |= {"critic": branches["critic"], "ensemble": {"member": jax.eval_shape(member.init, key, *inputs)}}
    numbers = {net: {name: thousands(part) for name, part in own.items()} for net, own in parts.items()}
    return numbers, ppo_explore.Args().members, steps


def write(ax, x, y, words, size=TEXT, **style):
    ax.text(x, y, words, fontsize=size, **{"ha": "center", "va": "center", "color": INK, "linespacing": 1.25} | style)


def rounded(ax, left, bottom, width, height, radius, fill, edge="none"):
    shape = f"round,pad=0,rounding_size={radius}"
    ax.add_patch(FancyBboxPatch((left, bottom), width, height, shape, fc=fill, ec=edge, lw=2))


def box(ax, x, y, width, height, words, fill, edge="none"):
    """A rounded box around (x, y), with words."""
    rounded(ax, x - width / 2, y - height / 2, width, height, 14, fill, edge)
    write(ax, x, y, words, color="white" if fill == CORE else INK)


def arrow(ax, start, end):
    style = {"arrowstyle": "-|>,head_width=0.45,head_length=0.8", "color": INK, "lw": 2.5, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", end, start, arrowprops=style)


def handover(ax, x, y, colour):
    """A broad arrow from one panel to the next."""
    shape = {"width": 26, "head_width": 56, "head_length": 30, "length_includes_head": True}
    ax.add_patch(FancyArrow(x, y, 62, 0, **shape, color=colour, lw=0, zorder=3))


def panel(ax, left, right, title, script):
    rounded(ax, left, 80, right - left, 748, 22, PANEL)
    write(ax, left + 24, 778, title, 32, ha="left", va="baseline", weight="bold")
    write(ax, left + 24, 740, script, ha="left", va="baseline", family="monospace")


def robot(ax, x, y):
    """A small quadruped."""
    rounded(ax, x - 52, y, 104, 30, 12, INK)
    rounded(ax, x + 50, y + 10, 30, 26, 9, INK)
    for hip, knee, foot in ((-42, -64, -48), (-30, -44, -18), (36, 20, 42), (46, 32, 64)):
        lift = 12 if foot in (-18, 64) else 0
        ax.plot([x + hip, x + knee, x + foot], [y + 12, y - 18, y - 50 + lift], color=INK, lw=7, solid_capstyle="round")


def cylinder(ax, x, y, width, height, words):
    ax.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, fc=ONCE, ec="none"))
    ax.add_patch(Ellipse((x, y - height / 2), width, 36, fc=ONCE, ec="none"))
    ax.add_patch(Ellipse((x, y + height / 2), width, 36, fc="#EEF0F2", ec=ONCE, lw=3))
    write(ax, x, y - 12, words)


def explore(ax, number, members):
    panel(ax, 12, 440, "1  Explore", "ppo_explore.py")
    box(ax, 226, 650, 380, 76, "exploration policy (PPO)", PLAIN, edge=INK)
    arrow(ax, (326, 612), (326, 530))
    write(ax, 342, 572, "$a_t$", ha="left")
    robot(ax, 328, 484)
    arrow(ax, (326, 418), (326, 336))
    cylinder(ax, 326, 224, 180, 160, "dataset\n$x_t,\\ a_t,\\ x_{t+1}$")
    arrow(ax, (236, 224), (214, 224))
    for shift in (14, 7, 0):
        box(ax, 113 + shift, 224 + shift, 166, 130, "", ONCE, edge=PANEL)
    write(ax, 113, 224, f"{members} small\nPIDMs\n{number} each")
    arrow(ax, (60, 303), (60, 612))
    write(ax, 74, 470, "reward:\ndisagreement", ha="left")


def pretrain(ax, number, steps):
    panel(ax, 492, 920, "2  Pretrain the PIDM", "pretrain_pidm.py")
    write(ax, 606, INPUTS, f"history\n$x_{{t-{steps}:t}},\\, a_{{t-{steps}:t-1}}$")
    write(ax, 806, INPUTS, "change\n$\\Delta x_{t+1}$")
    box(ax, 606, ENCODERS, 180, 110, f"history\nencoder\n{number['history_encoder']}", CORE)
    box(ax, 806, ENCODERS, 180, 110, f"delta\nencoder\n{number['delta_encoder']}", ONCE)
    box(ax, 706, BACKBONE, 380, 90, f"backbone\n{number['backbone']}", CORE)
    box(ax, 706, ENDS, 380, 84, f"prediction decoder\n{number['prediction_decoder']}", ONCE)
    for x in (606, 806):
        arrow(ax, (x, ENCODERS - 55), (x, BACKBONE + 47))
    arrow(ax, (706, BACKBONE - 45), (706, ENDS + 44))
    arrow(ax, (706, ENDS - 42), (706, OUTPUTS + 20))
    write(ax, 706, OUTPUTS, "action $\\hat{a}_t$")
    box(ax, 706, 126, 380, 56, "L1 loss  $|\\hat{a}_t - a_t|$", PLAIN, edge=INK)


def branch(ax, x, name, number, end, out):
    """Actor or critic, around x."""
    rounded(ax, x - 148, 166, 296, 558, 18, "white")
    write(ax, x, INPUTS + 18, name, weight="bold")
    write(ax, x - 70, INPUTS - 18, "history")
    write(ax, x + 70, INPUTS - 18, "obs $o_t$")
    box(ax, x - 70, ENCODERS, 132, 110, f"history\nencoder\n{number['history_encoder']}", CORE)
    box(ax, x + 70, ENCODERS, 132, 110, f"intention\nencoder\n{number['intention_encoder']}", NEW)
    box(ax, x - 20, BACKBONE, 232, 90, f"backbone\n{number['backbone']}", CORE)
    box(ax, x, ENDS, 272, 84, f"{end}\n{number[end.replace(' ', '_')]}", NEW)
    for side in (-70, 50):
        arrow(ax, (x + side, ENCODERS - 55), (x + side, BACKBONE + 47))
    arrow(ax, (x + 116, ENCODERS - 55), (x + 116, ENDS + 44))
    arrow(ax, (x - 20, BACKBONE - 45), (x - 20, ENDS + 44))
    arrow(ax, (x, ENDS - 42), (x, OUTPUTS + 20))
    write(ax, x, OUTPUTS, out)


def finetune(ax, numbers):
    panel(ax, 972, 1588, "3  Fine-tune actor and critic", "ppo_finetune.py")
    branch(ax, 1128, "actor", numbers["actor"], "action synthesizer", "action $a_t$")
    branch(ax, 1432, "critic", numbers["critic"], "value synthesizer", "value $V_t$")
    box(ax, 1280, 126, 600, 56, "PPO trains all weights, loaded and new", PLAIN, edge=INK)


def legend(ax):
    entries = (24, CORE, "pretrained in 2, loaded in 3"), (462, NEW, "new in 3"), (658, ONCE, "only in 1 or 2")
    for x, colour, words in entries:
        rounded(ax, x, 22, 34, 28, 8, colour)
        write(ax, x + 46, 28, words, ha="left", va="baseline")
    write(ax, 1580, 28, "in the boxes: numbers of parameters, Go1", ha="right", va="baseline")


def main():
    """Draw docs/method.png."""
    devices.find()
    fig = Figure((WIDTH / 72, HEIGHT / 72), dpi=72)  # so that a point is a pixel
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, WIDTH), ylim=(0, HEIGHT))
    ax.axis("off")
    numbers, members, steps = sizes()
    explore(ax, numbers["ensemble"]["member"], members)
    pretrain(ax, numbers["pidm"], steps)
    finetune(ax, numbers)
    handover(ax, 435, 224, "#8A939C")
    handover(ax, 915, BACKBONE, CORE)
    legend(ax)
    figures.save(fig, ROOT / "docs/method.png", dpi=72)
    print("wrote docs/method.png")


if __name__ == "__main__":
    with records.one_line_errors():
        tyro.cli(main, description=__doc__)
