"""`python -m envs.render.picture`: the scenes as `mjx` simulates them beside Meta-World's own.

A row shows one state: Meta-World's, recorded under its scripted policy, at the step where the
fixture has made half of its way, so that the hand is at the handle.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envs.command_line import Parser, make_directory, run, typed_path
from envs.figures import pyplot_for
from envs.outputs import FORCE_HELP, check_output, replacing, written_by
from envs.render.frames import choose_gl

SCENES = ("drawer", "window")
_WIDTH, _HEIGHT, _DPI = 420, 315, 100


def write_picture(scene: str, out: Path) -> None:
    """Draws the two tasks of a scene, Meta-World left and the port right, as a PNG.

    Raises:
        ValueError: matplotlib is missing (two lines: cause, cure).
    """
    pyplot = pyplot_for("a picture")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.patches import Patch

    from envs.render.port_scene import COLORS

    tasks = (f"{scene}-open", f"{scene}-close")
    figure, axes = pyplot.subplots(2, 3, figsize=(3 * _WIDTH / _DPI, (2 * _HEIGHT + 110) / _DPI))
    for row, task in zip(axes, tasks, strict=True):
        step, *pictures = draw_task(task)
        titles = (f"{task}, step {step}: Meta-World", "the same state in mjx", "its hand, closer")
        for axis, picture, title in zip(row, pictures, titles, strict=True):
            axis.imshow(picture)
            axis.set_title(title)
            axis.set_axis_off()
    handles = [Patch(facecolor=c, edgecolor="k", label=role) for role, c in COLORS.items()]
    figure.legend(handles=handles, loc="lower center", ncols=4, frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    pyplot.close(figure)
    # Five bits a channel: half the file, and still the colours of the legend.
    with replacing(out) as part:
        text = {"Software": written_by("envs.render.picture")}
        pyplot.imsave(part, pixels // 8 * 8 + pixels // 32, metadata=text)


def draw_task(task: str) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """One state of a task: its step, Meta-World's picture, the port's, and the port's hand."""
    from envs.render.frames import Renderer, camera_of, metaworld_scene
    from envs.render.port_scene import SPHERES, port_shapes, to_model

    step, qpos, placement = half_way(task)
    camera = camera_of(task, placement)
    shapes = port_shapes(task.split("-")[0], qpos, placement)
    x, y, z = np.mean([shape.pos for shape in shapes if shape.role == SPHERES], 0)
    close = camera._replace(lookat=(x, y, z), distance=0.36)
    with Renderer(metaworld_scene(task, placement), _WIDTH, _HEIGHT) as renderer:
        reference = renderer.draw(qpos, camera)
    with Renderer(to_model(shapes), _WIDTH, _HEIGHT) as renderer:
        port, hand = (renderer.draw(np.empty(0), view) for view in (camera, close))
    return step, reference, port, hand


def half_way(task: str) -> tuple[int, np.ndarray, np.ndarray]:
    """The step where the scripted policy has moved the fixture half of its way.

    Returns:
        The step, qpos (10,) and the fixture's placement (3,) in Meta-World, on the first goal of
        the set `heldout`.
    """
    from envs.goal_sets import load_goal_set
    from envs.parity.reference import record_rollout
    from envs.physics.model import SLIDE

    placement = load_goal_set("heldout", (task,))[0, 0]
    rollout = record_rollout(task, placement, "scripted", steps=120)
    way = np.abs(rollout.qpos[:, SLIDE] - rollout.qpos[0, SLIDE])
    step = int(np.argmax(way >= way.max() / 2))
    return step, rollout.qpos[step], placement


def main(argv: Sequence[str] | None = None) -> int:
    """Writes drawer.png and window.png; a mistake of the user is two lines and exit code 2."""
    return run(lambda: _write_pictures(argv))


def _write_pictures(argv: Sequence[str] | None) -> None:
    parser = Parser(
        prog="python -m envs.render.picture",
        description="Draws both scenes as simulated by the mjx backend beside Meta-World's own.",
        allow_abbrev=False,
    )
    default = Path("envs/pictures")
    parser.add_argument(
        "--out", type=typed_path, default=default, metavar="DIR", help=f"[{default}]"
    )
    parser.add_argument("--force", action="store_true", help=FORCE_HELP)
    args = parser.parse_args(argv)
    out = args.out
    choose_gl()  # before a directory is made for pictures that cannot be drawn
    make_directory(out, "--out")
    for scene in SCENES:
        check_output(out / f"{scene}.png", "--out", written_by("envs.render.picture"), args.force)
    for scene in SCENES:
        write_picture(scene, out / f"{scene}.png")
        print(out / f"{scene}.png")


if __name__ == "__main__":
    raise SystemExit(main())
