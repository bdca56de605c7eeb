import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from hdrqn_torchrl.transforms.window import Window, cut_out, interpolated, resized

SCREEN = torch.arange(6 * 8, dtype=torch.uint8).view(6, 8, 1)  # rows of 8


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((3.0, 3.0), [[18, 19], [26, 27]]),
        ((0.0, 3.0), [[0, 16], [0, 24]]),  # half of it beyond the left edge
        ((8.0, 6.0), [[47, 0], [0, 0]]),
        ((-5.0, 3.0), [[0, 0], [0, 0]]),
    ],
)
def test_cut_out_takes_a_window_around_a_position(position, expected):
    assert cut_out(SCREEN, torch.tensor(position), 2).squeeze(-1).tolist() == expected


def test_each_screen_has_its_own_window():
    screens = torch.randint(256, (4, 2, 6, 8, 3), dtype=torch.uint8)
    positions = torch.rand(4, 2, 2) * 8
    windows = cut_out(screens, positions, 3)
    assert windows.shape == (4, 2, 3, 3, 3)
    for i in range(4):
        for j in range(2):
            assert (windows[i, j] == cut_out(screens[i, j], positions[i, j], 3)).all()


def test_resizing_keeps_means_and_puts_channels_first():
    screens = torch.randint(256, (5, 70, 70, 3), dtype=torch.uint8)
    images = resized(screens, 35)
    assert images.shape == (5, 3, 35, 35) and images.dtype == torch.uint8 and images.is_contiguous()
    assert (images.float().mean((2, 3)) - screens.float().mean((1, 2))).abs().max() < 1.0
    flat = torch.full((2, 70, 70, 3), 7, dtype=torch.uint8)
    assert (resized(flat, 44) == 7).all()


@pytest.mark.parametrize("keep", [False, True])
def test_the_screen_is_removed_unless_keep_pixels(keep):
    step = TensorDict({"pixels": torch.zeros(3, 210, 160, 3, dtype=torch.uint8), "position": torch.zeros(3, 2)}, [3])
    after = Window(keep_pixels=keep).forward(step)
    assert after["observation"].shape == (3, 3, 44, 44)
    assert ("pixels" in after) == keep


def test_all_keys_can_be_renamed():
    step = TensorDict({("a", "screen"): torch.ones(10, 10, 3, dtype=torch.uint8)}, [])
    after = Window(view=None, size=5, pixels_key=("a", "screen"), out_key=("a", "small")).forward(step)
    assert after["a", "small"].shape == (3, 5, 5)
    assert ("a", "screen") not in after.keys(True)


@pytest.mark.parametrize("settings", [{"view": 0}, {"size": 0}])
def test_wrong_settings_are_refused(settings):
    (name,) = settings
    with pytest.raises(ValueError, match=f"{name} must be >= 1.*, got 0; "):
        Window(**settings)


def test_specs_of_an_environment_with_a_window():
    pytest.importorskip("ale_py")
    from hdrqn_torchrl.envs import MontezumaEnv

    env = TransformedEnv(MontezumaEnv(2, seed=0), Window(view=None, size=33))
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (2, 3, 33, 33)


class TestInterpolated:
    """On a GPU there is no kernel for bytes; matrix products give the same numbers."""

    SIDES = ((70, 70), (210, 160), (44, 44), (44, 70), (30, 33), (5, 7), (1, 9), (100, 3), (88, 88), (45, 43))

    @pytest.mark.parametrize("size", [44, 84, 33, 7, 100, 2, 1])
    @pytest.mark.parametrize("channels", [1, 3, 4])
    def test_interpolated_equals_interpolate_on_a_cpu(self, size, channels):
        """Both memory layouts: PyTorch has a kernel for each. (That of layers side by side fails for size 1.)"""
        for sides in self.SIDES:
            images = torch.randint(256, (2, *sides, channels), dtype=torch.uint8).permute(0, 3, 1, 2)
            images[0] = images[0] // 128 * 255  # black and white: the sharpest edges
            found = interpolated(images, size)
            assert found.dtype == torch.uint8
            for layout in [images] if size == 1 else [images, images.contiguous()]:
                assert (found == expected(layout, size)).all(), sides

    def test_other_devices_use_interpolated(self, monkeypatch):
        screens = torch.randint(256, (2, 5, 70, 70, 3), dtype=torch.uint8)
        images = resized(screens, 44)
        monkeypatch.setattr("hdrqn_torchrl.transforms.window.on_host", lambda tensor: False)
        monkeypatch.setattr("hdrqn_torchrl.transforms.window.interpolate", None)
        again = resized(screens, 44)
        assert (again == images).all() and again.is_contiguous() and again.shape == (2, 5, 3, 44, 44)


def expected(images, size):
    return torch.nn.functional.interpolate(images, (size, size), mode="bilinear", antialias=True, align_corners=False)
