"""Writes recorded episodes to GIF and MP4 files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hdrqn_torchrl.rendering.frames import Frame
from hdrqn_torchrl.rendering.levels import bar_spans
from hdrqn_torchrl.rendering.picture import HEIGHT, WIDTH, draw_frame

_COLOURS = 64  # size of a GIF's palette
_SAMPLES = 24  # number of pictures from which the palette is made


def hold(frame: Frame, fps: int) -> int:
    """Ticks that a frame lasts: two if an option starts, two seconds at the end of an episode, else one."""
    if frame.outcome:
        return 2 * fps
    return 2 if frame.starts_option else 1


def check_video(path: Path | None, *, fps: int) -> None:
    """Refuses, before any episode is played, what :func:`write_video` or a terminal can't show.

    Args:
        path: file to write; ``None`` for a terminal.
        fps: steps per second.

    Raises:
        ValueError: if the file does not end in .gif or .mp4, PyAV is missing, or ``fps`` is out of range.
    """
    if path is not None and path.suffix.lower() not in _WRITERS:
        raise ValueError(f"out must end in {' or '.join(_WRITERS)}, or be terminal, got {str(path)!r}.")
    if path is not None and path.suffix.lower() == ".mp4" and find_spec("av") is None:
        raise ValueError("out=*.mp4 needs PyAV: pip install 'hdrqn_torchrl[video]', or write a .gif.")
    if not 1 <= fps <= 50:
        raise ValueError(f"fps must lie in [1, 50], got {fps}; use 4 to follow each step.")


def write_video(frames: Sequence[Frame], path: str | Path, *, fps: int = 4, width: int = WIDTH) -> None:
    """Writes a GIF that loops forever, or an MP4 (H.264), which needs PyAV.

    Args:
        frames: what :func:`~hdrqn_torchrl.rendering.record_episodes` returned, at least one.
        path: file to write; its ending chooses the format.
        fps: steps per second.
        width: of the pictures; less than 760 makes them and the file smaller.

    Raises:
        ValueError: see :func:`check_video`.

    Examples:
        >>> import tempfile
        >>> from hdrqn_torchrl.algorithms import make_hdrqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> from hdrqn_torchrl.rendering import record_episodes
        >>> env = MultiGoalGridEnv(num_envs=1, max_steps=3)
        >>> agent = make_hdrqn(env, compact_network(8, (8,)))
        >>> path = Path(tempfile.mkdtemp()) / "episode.gif"
        >>> write_video(record_episodes(agent.transform(env), agent), path, width=400)
        >>> path.read_bytes()[:6]
        b'GIF89a'
    """
    path = Path(path)
    check_video(path, fps=fps)
    if not frames:
        raise ValueError("frames must hold at least one frame, got none; use record_episodes.")
    _WRITERS[path.suffix.lower()](frames, path, fps, (width, 2 * round(width * HEIGHT / WIDTH / 2)))


def _write_gif(frames: Sequence[Frame], path: Path, fps: int, size: tuple[int, int]) -> None:
    palette, indices = _palette(frames)
    images = (_with_palette(picture, palette, indices) for picture in _pictures(frames, size))
    next(images).save(
        path,
        format="GIF",
        save_all=True,
        append_images=images,
        duration=[round(1000 * hold(frame, fps) / fps) for frame in frames],
        loop=0,
        optimize=True,  # leaves out pixels that have not changed
    )


def _write_mp4(frames: Sequence[Frame], path: Path, fps: int, size: tuple[int, int]) -> None:
    import av

    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps)
        (stream.width, stream.height), stream.pix_fmt = size, "yuv420p"
        for frame, picture in zip(frames, _pictures(frames, size), strict=True):
            for _ in range(hold(frame, fps)):
                container.mux(stream.encode(av.VideoFrame.from_image(picture)))
        container.mux(stream.encode())


_WRITERS = {".gif": _write_gif, ".mp4": _write_mp4}


def _pictures(frames: Sequence[Frame], size: tuple[int, int] = (WIDTH, HEIGHT)) -> Iterator[Image.Image]:
    """Draws the pictures one at a time, as all of them would fill the memory."""
    spans = bar_spans(frames)
    pictures = (Image.fromarray(draw_frame(frame, spans)) for frame in frames)
    return (picture if picture.size == size else picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures)


def _palette(frames: Sequence[Frame]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The most common colours ``[C, 3]``, and for every coarse colour the index of the nearest of them ``[2**15]``.

    With one palette for all pictures, still parts stay equal and the file small. Pillow's own palettes shift plain
    colours.
    """
    sample = [*frames[:: -(-len(frames) // _SAMPLES)], *[frame for frame in frames if frame.outcome][:_SAMPLES]]
    pixels = np.concatenate([np.asarray(picture).reshape(-1, 3) for picture in _pictures(sample)])
    colours, counts = np.unique(pixels.astype(np.int64) @ (1 << 16, 1 << 8, 1), return_counts=True)
    colours = colours[np.argsort(-counts, kind="stable")]
    colours = np.stack([colours >> 16, colours >> 8 & 255, colours & 255], -1)
    _, first = np.unique(_coarse(colours), return_index=True)  # the most common of each coarse colour
    colours = colours[np.sort(first)[:_COLOURS]]
    axis = np.arange(4, 256, 8)
    every = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 1, 3)
    indices = ((every - colours) ** 2).sum(-1).argmin(-1)
    indices[_coarse(colours)] = np.arange(len(colours))
    return colours.astype(np.uint8), indices.astype(np.uint8)


def _coarse(colours: NDArray) -> NDArray:
    """The upper five bits of each channel as one number, ``[*, 3]`` -> ``[*]``."""
    return (colours >> 3).astype(np.int64) @ (1 << 10, 1 << 5, 1)


def _with_palette(picture: Image.Image, palette: NDArray[np.uint8], indices: NDArray[np.uint8]) -> Image.Image:
    image = Image.fromarray(indices[_coarse(np.asarray(picture))])
    image.putpalette(palette.tobytes())
    return image
