import numpy as np
import pytest
from helpers import build
from PIL import Image
from walk import walk

from hdrqn_torchrl.envs import MultiGoalGridEnv
from hdrqn_torchrl.rendering import bar_spans, check_video, draw_frame, hold, record_episodes, video, write_video


def read_gif(path):
    """Pictures and durations in milliseconds."""
    image = Image.open(path)
    pictures, durations = [], []
    for index in range(image.n_frames):
        image.seek(index)
        pictures.append(np.asarray(image.convert("RGB")).astype(int))
        durations.append(image.info["duration"])
    return pictures, durations


def test_frames_are_held_longer_where_an_option_starts_and_an_episode_ends():
    assert [hold(frame, 4) for frame in walk("v2")] == [2, 1, 2, 8]
    assert [hold(frame, 1) for frame in walk("drqn")] == [1, 1, 1, 2]


def test_a_written_gif_holds_every_frame(tmp_path):
    frames = walk("v2", recording={"episodes": 2})
    write_video(frames, tmp_path / "episode.gif", fps=4)
    pictures, durations = read_gif(tmp_path / "episode.gif")
    assert durations == [500, 250, 500, 2000] * 2
    assert Image.open(tmp_path / "episode.gif").info["loop"] == 0
    spans = bar_spans(frames)
    for frame, picture in zip(frames, pictures, strict=True):
        wanted = draw_frame(frame, spans).astype(int)
        assert (picture == wanted).all(-1).mean() > 0.97  # plain colours stay; the soft edges of letters may shift
        assert abs(picture - wanted).max() < 64


def test_fps_decides_the_duration_of_frames(tmp_path):
    write_video(walk("v2"), tmp_path / "fast.gif", fps=20)
    assert read_gif(tmp_path / "fast.gif")[1] == [100, 50, 100, 2000]


def test_narrower_pictures_make_a_smaller_file_in_the_same_colours(tmp_path):
    for width in (760, 440):
        write_video(walk("v2"), tmp_path / f"{width}.gif", width=width)
    sizes = [(tmp_path / f"{width}.gif").stat().st_size for width in (760, 440)]
    pictures, durations = read_gif(tmp_path / "440.gif")
    assert {picture.shape for picture in pictures} == {(264, 440, 3)} and durations == [500, 250, 500, 2000]
    assert sizes[1] < sizes[0]
    assert (pictures[-1][250, 430] == (44, 160, 44)).all()


def test_a_gif_of_one_frame_can_be_written(tmp_path):
    write_video(walk("v2")[:1], tmp_path / "one.gif")
    assert len(read_gif(tmp_path / "one.gif")[0]) == 1


def test_gifs_are_small(tmp_path):
    env = MultiGoalGridEnv(1, max_steps=12)
    agent = build("v2", env)
    frames = record_episodes(agent.transform(env), agent, epsilon=0.8)
    write_video(frames, tmp_path / "episode.gif")
    assert (tmp_path / "episode.gif").stat().st_size / len(frames) < 8_000


def test_the_colours_of_an_end_are_in_the_palette_even_of_a_long_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "_SAMPLES", 1)  # of the steps, only the first is looked at
    write_video(walk("drqn"), tmp_path / "late.gif")
    assert (read_gif(tmp_path / "late.gif")[0][-1][430, 740] == (44, 160, 44)).all()


def test_a_written_mp4_holds_every_frame(tmp_path):
    av = pytest.importorskip("av")
    frames = walk("v2")
    write_video(frames, tmp_path / "episode.mp4", fps=4)
    with av.open(str(tmp_path / "episode.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 4
        pictures = [picture.to_ndarray(format="rgb24").astype(int) for picture in container.decode(stream)]
    wanted = [draw_frame(frame, bar_spans(frames)) for frame in frames for _ in range(hold(frame, 4))]
    assert len(pictures) == 13
    for picture, original in zip(pictures, wanted, strict=True):
        assert abs(picture - original).mean() < 4


def test_without_pyav_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(video, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'hdrqn_torchrl\[video\]'"):
        check_video(tmp_path / "x.mp4", fps=4)
    check_video(tmp_path / "x.gif", fps=4)
    check_video(tmp_path / "x.GIF", fps=4)


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        ("x.avi", 4, r"out must end in .gif or .mp4, or be terminal, got '.*x.avi'"),
        ("x", 4, "out must end in"),
        ("x.gif", 0, r"fps must lie in \[1, 50\], got 0"),
        ("x.gif", 51, "fps must lie in"),
    ],
)
def test_other_file_endings_and_fps_are_refused(tmp_path, name, fps, message):
    with pytest.raises(ValueError, match=message):
        write_video(walk("v2"), tmp_path / name, fps=fps)
    assert not list(tmp_path.iterdir())


def test_an_empty_recording_is_refused(tmp_path):
    with pytest.raises(ValueError, match="frames must hold at least one frame"):
        write_video([], tmp_path / "x.gif")
