"""A run as a moving picture: the bodies of every peer as `still_picture` draws them, from frame to frame.

Takes: a `Model` and its `Trajectory`. Gives: `SUFFIXES`, `check_animation`, `save_animation`.
Guarantees: frames show rows of the trajectory, the nearest in time; all moving bodies stay inside the axes.
The speed relative to real time is in the title. A file is written completely or not at all.
Does not: simulate the model, or need a display.

matplotlib is loaded when something is drawn and not before; it writes GIF by Pillow, MP4 by ffmpeg.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.compiled import Model
from apc.compiler.files import check_target, write_file
from apc.compiler.timings import part
from apc.output.object_shapes import heading
from apc.output.still_picture import MM, draw_actors, keep_in_sight, widen
from apc.support.optional import missing, need

if TYPE_CHECKING:
    from apc.simulation.trajectory import Trajectory

SUFFIXES = (".gif", ".mp4")
RATE = 20  # frames a second
SHORTEST, LONGEST = 4.0, 12.0  # seconds that it can be watched for
DPI = 90


def check_animation(path: Path) -> None:
    """Refuse an animation that cannot be written: E601 the path, E875 matplotlib or ffmpeg is missing."""
    check_target(path)
    writers = need("matplotlib.animation", "plot").writers
    if path.suffix.lower() == ".mp4" and not writers.is_available("ffmpeg"):
        message = "ffmpeg is not installed, which writes .mp4"
        fix = f"--out {path.with_suffix('.gif')}, or apt install ffmpeg"
        raise missing(message, fix)


@part("draw")
def save_animation(model: Model, trajectory: Trajectory, path: Path) -> None:
    """Draw a run into a file that moves, its format chosen by the suffix.

    Parameters
    ----------
    model
        The model.
    trajectory
        Its run, with the positions of all bodies among the signals.
    path
        A .gif or .mp4.

    Raises
    ------
    ApcError
        E601 it can't be written, E875 matplotlib or ffmpeg is not installed.
    """
    check_animation(path)
    moving = need("matplotlib.animation", "plot")
    figure, actors, lines = draw_actors(model)
    columns = {signal.name: index for index, signal in enumerate(trajectory.signals)}
    tracks = [MM * trajectory.values[:, [columns[name] for name in actor.states]] for actor in actors]
    turns = [heading(trajectory.values[:, [columns[text] for text in actor.turning]]) for actor in actors]
    for actor, track in zip(actors, tracks, strict=True):
        widen(actor, track)
    if actors:
        keep_in_sight([actor.ax for actor in actors])
    start, end = float(trajectory.time[0]), float(trajectory.time[-1])
    seconds = min(max(end - start, SHORTEST), LONGEST)
    times = np.linspace(start, end, round(RATE * seconds) + 1)
    rows = np.minimum(np.searchsorted(trajectory.time, times), len(trajectory.time) - 1)
    speed = (end - start) / seconds
    pace = "" if abs(speed - 1) < 1e-3 else f", {speed:.2g} × real time"
    pixels = [2 * round(side * DPI / 2) for side in figure.get_size_inches()]  # ffmpeg requires even numbers
    figure.set_size_inches(*(side / DPI for side in pixels))
    title = figure.suptitle(" ", fontsize=11)
    moved = [artist for actor in actors for artist in actor.artists]
    _paint_fixed_parts(figure, [title, *(line.line for line in lines), *moved])

    writer = moving.writers["ffmpeg" if path.suffix.lower() == ".mp4" else "pillow"](fps=RATE)

    def write(temporary: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="apc-animation-") as folder:
            named = Path(folder, f"moving{path.suffix.lower()}")  # writers go by the suffix
            with writer.saving(figure, named, DPI):
                for row in rows.tolist():
                    title.set_text(f"{model.name}: {trajectory.time[row]:.3f} s{pace}")
                    for actor, track, turn in zip(actors, tracks, turns, strict=True):
                        actor.move(track[row], turn[row])
                    for line in lines:
                        line.draw()
                    writer.grab_frame()
            shutil.copyfile(named, temporary)

    write_file(path, write)


def _paint_fixed_parts(figure: Any, moving: Sequence[Any]) -> None:
    """Draw all fixed parts once, as an image behind the moving ones, so that no frame draws its axes."""
    agg = need("matplotlib.backends.backend_agg", "plot")
    figure.set_dpi(DPI)
    figure.draw_without_rendering()  # which lays it out, with room for all
    figure.set_layout_engine("none")
    for item in moving:
        item.set_visible(False)
    canvas = agg.FigureCanvasAgg(figure)
    canvas.draw()
    painted = np.array(canvas.buffer_rgba())
    for item in [*figure.legends, *(child for ax in figure.axes for child in ax.get_children())]:
        item.set_visible(False)
    for item in moving:
        item.set_visible(True)
    figure.figimage(painted, zorder=-1)
