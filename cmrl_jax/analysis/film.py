"""Episodes as a video and as a contact sheet: what `train.py render` writes for a task.

pillow and imageio-ffmpeg, which brings an ffmpeg along, are an extra (`viz`).
"""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from cmrl_jax.config.schema import ConfigError
from envs.outputs import replacing, written_by
from envs.render.frames import Renderer, camera_of, metaworld_scene

CONTROL_RATE = 80  # control steps a second: 5 substeps of 2.5 ms
WIDTH, HEIGHT, STRIP = 480, 352, 32  # of a frame: picture, and the strip of text below it; pixels
_SHEET_COLUMNS = 6
_TEXT_SIZE = 16
_SUCCESS = "limegreen"


@dataclass(frozen=True)
class Episode:
    """What happened in one episode of H control steps; row 0 is the start.

    Attributes:
        name: what the episode is for.
        qpos: (H + 1, 10) joint positions.
        success: (H + 1,) whether that very step succeeds.
        returns: sum of rewards.
        acted_on: what the policy knew or tried, in a few words.
    """

    name: str
    qpos: np.ndarray
    success: np.ndarray
    returns: float
    acted_on: str = ""

    def verdict(self, step: int) -> str:
        """Whether the episode has succeeded by a step, and when."""
        reached = np.flatnonzero(self.success[: step + 1])
        return f"success at step {reached[0]}" if len(reached) else "no success yet"

    @property
    def outcome(self) -> str:
        """The whole episode in words."""
        verdict = self.verdict(len(self.qpos) - 1).removesuffix(" yet")
        return f"{verdict}, return {self.returns:.0f}"


@dataclass(frozen=True)
class Film:
    """The episodes of one adaptation run, in order.

    Attributes:
        task: task name.
        caption: where they come from, one line.
        placement: (3,) the fixture's position, metres.
    """

    task: str
    caption: str
    placement: np.ndarray
    episodes: tuple[Episode, ...]


class Camera:
    """Takes pictures of a film in Meta-World's own scene; a context manager, as `Renderer`."""

    def __init__(self, film: Film):
        view = camera_of(film.task, film.placement)
        x, y, z = view.lookat
        # From farther off and higher: a policy takes the hand anywhere.
        self._view = view._replace(lookat=(x, y, z + 0.06), distance=1.3 * view.distance)
        scene = metaworld_scene(film.task, film.placement)
        scene.vis.quality.shadowsize = 1024  # finer shadows are half of the time without a GPU
        self._renderer = Renderer(scene, WIDTH, HEIGHT)

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *error: object) -> None:
        self._renderer.close()

    def take(self, episode: Episode, step: int) -> np.ndarray:
        """A picture (HEIGHT, WIDTH, 3) uint8 of one step."""
        return self._renderer.draw(episode.qpos[step], self._view)


def write_video(film: Film, camera: Camera, every: int, path: Path) -> None:
    """Writes all episodes as one mp4 at real speed, a frame every `every` control steps.

    Raises:
        ConfigError: ffmpeg cannot write the file.
        ValueError: it cannot take the place of `path` (two lines: cause, cure).
    """
    from imageio_ffmpeg import get_ffmpeg_exe

    # Not through imageio, which forks in a way that jax's threads do not allow.
    size, rate = f"{WIDTH}x{HEIGHT + STRIP}", str(CONTROL_RATE / every)
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-"]
    made = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "23", "-movflags", "+faststart"]
    made += ["-metadata", f"comment={written_by('render')}"]
    command = [get_ffmpeg_exe(), "-y", "-loglevel", "error", *given, *made]
    with tempfile.TemporaryFile() as errors, replacing(path) as part:
        process = subprocess.Popen([*command, str(part)], stdin=subprocess.PIPE, stderr=errors)
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin as pipe:
            for episode in film.episodes:
                for step in range(0, len(episode.qpos), every):
                    pipe.write(_frame(film.task, episode, step, camera).tobytes())
        if process.wait():
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            cause = f"ffmpeg cannot write {path}: {lines[-1] if lines else 'no reason given'}"
            raise ConfigError(cause, "make room there, or give --out another directory")


def _frame(task: str, episode: Episode, step: int, camera: Camera) -> Image.Image:
    """A picture with a strip of text below it: task, episode, step, success."""
    frame = Image.new("RGB", (WIDTH, HEIGHT + STRIP), "white")
    frame.paste(Image.fromarray(camera.take(episode, step)), (0, 0))
    draw, middle = ImageDraw.Draw(frame), HEIGHT + STRIP // 2
    font = ImageFont.load_default(_TEXT_SIZE)
    draw.text((8, middle), f"{task}: {episode.name}", "black", font, "lm")
    verdict = episode.verdict(step)
    color = _SUCCESS if verdict.startswith("success") else "black"
    draw.text((WIDTH - 8, middle), f"step {step}: {verdict}", color, font, "rm")
    return frame


def write_sheet(film: Film, camera: Camera, path: Path, rows: int = 3) -> None:
    """Writes a PNG: time to the right, and a row an episode.

    Args:
        rows: at most so many, the first, the last and what lies evenly between.
    """
    last = len(film.episodes) - 1
    shown = np.unique(np.linspace(0, last, min(rows, last + 1)).round().astype(int))
    width, height = WIDTH * 2 // 3, HEIGHT * 2 // 3
    size = (width * _SHEET_COLUMNS, STRIP + (height + STRIP) * len(shown))
    sheet = Image.new("RGB", size, "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT_SIZE)
    draw.text((8, STRIP // 2), f"{film.task}: {film.caption}", "black", font, "lm")
    for i, row in enumerate(shown):
        episode, top = film.episodes[row], STRIP + (height + STRIP) * i
        end = len(episode.qpos) - 1
        words = filter(None, (episode.acted_on, episode.outcome))
        line = f"{episode.name}: {', '.join(words)}"
        draw.text((8, top + STRIP // 2), line, "black", font, "lm")
        for column, step in enumerate(np.linspace(0, end, _SHEET_COLUMNS).round().astype(int)):
            picture = Image.fromarray(camera.take(episode, step)).resize((width, height))
            corner = (width * column, top + STRIP)
            sheet.paste(picture, corner)
            text, color = f"step {step}", "white"
            if episode.success[step]:
                text, color = f"{text}: success", _SUCCESS
            box = draw.textbbox((corner[0] + 6, corner[1] + 4), text, font)
            draw.rectangle((box[0] - 3, box[1] - 3, box[2] + 3, box[3] + 3), "black")
            draw.text((corner[0] + 6, corner[1] + 4), text, color, font)
    text = PngInfo()
    text.add_text("Software", written_by("render"))
    with replacing(path) as part:
        sheet.save(part, optimize=True, pnginfo=text)
