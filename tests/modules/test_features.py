import pytest
import torch

from hdrqn_torchrl.envs.grid.cells import palette
from hdrqn_torchrl.modules import CellFeatures, CellsToImage, ConvFeatures, FullyConnectedFeatures


class TestCellsToImage:
    def test_every_pixel_has_the_colour_of_its_cell(self):
        cells = torch.tensor([[0, 1], [2, 3]], dtype=torch.uint8)
        image = CellsToImage(view=2, num_codes=4, size=6)(cells)
        for row in range(6):
            for column in range(6):
                code = cells[row // 3, column // 3].long()
                assert image[:, row, column].tolist() == pytest.approx((palette(4)[code] / 255).tolist())

    def test_cells_get_about_equal_numbers_of_pixels_if_these_do_not_divide(self):
        cells = torch.arange(3, dtype=torch.uint8).repeat(3, 1)
        row = CellsToImage(view=3, num_codes=3, size=44)(cells)[:, 0]
        codes = [(palette(3).t() / 255 == row[:, [x]]).all(0).nonzero().item() for x in range(44)]
        assert codes == sorted(codes) and [codes.count(code) for code in range(3)] == [15, 15, 14]

    def test_any_leading_dimensions(self):
        cells = torch.randint(5, (2, 3, 5, 5), dtype=torch.uint8)
        draw = CellsToImage(view=5, num_codes=5)
        assert draw(cells).shape == (2, 3, 3, 44, 44)
        assert (draw(cells)[1, 2] == draw(cells[1, 2])).all()


class TestConvFeatures:
    def test_uint8_and_float_images_give_the_same_features(self):
        torch.manual_seed(0)
        features, image = ConvFeatures(channels=(4, 4, 4, 4)), torch.randint(256, (2, 3, 44, 44), dtype=torch.uint8)
        torch.testing.assert_close(features(image), features(image.float() / 255))

    @pytest.mark.parametrize("leading", [(), (2,), (2, 3)])
    def test_any_leading_dimensions(self, leading):
        torch.manual_seed(0)
        features = ConvFeatures(out_features=7, channels=(4, 4, 4, 4))
        image = torch.rand(*leading, 3, 44, 44)
        assert features(image).shape == (*leading, 7)
        expected = features(image[(0,) * len(leading)])
        torch.testing.assert_close(features(image)[(0,) * len(leading)], expected)

    def test_conv_features_are_four_convolutions_and_a_dense_layer_with_relu(self):
        kinds = [type(layer).__name__ for layer in ConvFeatures().modules() if not list(layer.children())]
        assert kinds == ["Conv2d", "ReLU"] * 4 + ["Flatten", "Linear", "ReLU"]
        assert ConvFeatures().out_features == 256

    @pytest.mark.parametrize("size", [33, 44, 84])
    def test_image_sizes_from_33_pixels_are_accepted(self, size):
        assert ConvFeatures(1, size, 5, channels=(2, 2, 2, 2))(torch.zeros(1, 1, size, size)).shape == (1, 5)

    @pytest.mark.parametrize(
        ("side", "kernels", "strides"),
        [
            (84, [5, 3, 3, 3], [2, 2, 2, 1]),
            (33, [5, 3, 3, 3], [2, 2, 2, 1]),
            (32, [5, 3, 3, 3], [2, 2, 1, 1]),
            (20, [5, 3, 3, 3], [2, 1, 1, 1]),
            (10, [5, 3, 3, 2], [1, 1, 1, 1]),
            (7, [5, 3, 1, 1], [1, 1, 1, 1]),
            (1, [1, 1, 1, 1], [1, 1, 1, 1]),
        ],
    )
    def test_convolutions_fit_each_side_of_an_image(self, side, kernels, strides):
        features = ConvFeatures(2, (44, side), 5, channels=(2, 2, 2, 2))
        convolutions = [layer for layer in features.convolutions if isinstance(layer, torch.nn.Conv2d)]
        assert [layer.kernel_size for layer in convolutions] == list(zip([5, 3, 3, 3], kernels, strict=True))
        assert [layer.stride for layer in convolutions] == list(zip([2, 2, 2, 1], strides, strict=True))
        assert features(torch.zeros(3, 2, 44, side, dtype=torch.uint8)).shape == (3, 5)

    def test_images_of_any_size_are_read(self):
        for height in range(1, 36):
            width = (7 * height) % 41 + 1
            assert ConvFeatures(1, (height, width), 3, channels=(2, 2, 2, 2))(torch.zeros(1, height, width)).shape == (
                3,
            )

    def test_sizes_that_are_no_height_and_width_are_refused(self):
        with pytest.raises(ValueError, match=r"size must be one number, or height and width, got \(1, 2, 3\); "):
            ConvFeatures(size=(1, 2, 3))
        with pytest.raises(ValueError, match=r"size\[1\] must be >= 1, got 0; "):
            ConvFeatures(size=(1, 0))


class TestVectors:
    def test_cell_features_depend_on_code_and_place_of_every_cell(self):
        torch.manual_seed(0)
        features = CellFeatures(view=3, num_codes=5, widths=(64,))
        seen = {tuple(features(torch.zeros(3, 3, dtype=torch.uint8)).tolist())}
        for place in range(9):
            for code in range(1, 5):
                cells = torch.zeros(9, dtype=torch.uint8)
                cells[place] = code
                seen.add(tuple(features(cells.view(3, 3)).tolist()))
        assert len(seen) == 1 + 9 * 4

    def test_cell_features_take_any_leading_dimensions(self):
        features = CellFeatures(view=3, num_codes=5, widths=(6, 4))
        cells = torch.randint(5, (2, 7, 3, 3), dtype=torch.uint8)
        assert features(cells).shape == (2, 7, 4) and features.out_features == 4
        torch.testing.assert_close(features(cells)[1, 6], features(cells[1, 6]))

    @pytest.mark.parametrize(("view", "like_5x5"), [(3, 9 / 25), (5, 1.0), (19, 1.0)])
    def test_one_step_of_adam_has_the_same_effect_for_every_view(self, view, like_5x5):
        """Without scaling, a step changes the output more for a larger window, and whole maps were hardly learned."""
        torch.manual_seed(0)
        moved = []
        for side in (view, 5):
            features = CellFeatures(side, num_codes=5, widths=(64,))
            cells = torch.randint(5, (side, side), dtype=torch.uint8)
            before = features.dense[0](features._one_hot[cells.int()].flatten()).detach()
            assert before.std() == pytest.approx(0.26, abs=0.06)
            features(cells).sum().backward()
            active = features.dense[0].weight.grad != 0
            with torch.no_grad():
                features.dense[0].weight += 1e-3 * active
            on = active.any(1)
            after = features.dense[0](features._one_hot[cells.int()].flatten())
            moved.append((after - before)[on].mean().item())
        assert moved[0] / moved[1] == pytest.approx(like_5x5, rel=1e-2)

    def test_fully_connected_features_are_the_papers_four_layers(self):
        features = FullyConnectedFeatures(10)
        shapes = [tuple(p.shape) for p in features.parameters() if p.ndim == 2]
        assert shapes == [(256, 10), (256, 256), (256, 256), (256, 256)]
        assert features(torch.zeros(2, 3, 10)).shape == (2, 3, features.out_features)

    @pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64])
    def test_fully_connected_features_accept_any_dtype(self, dtype):
        features, one_hot = FullyConnectedFeatures(3, (4,)), torch.eye(3)
        assert torch.equal(features(one_hot.to(dtype)), features(one_hot))
