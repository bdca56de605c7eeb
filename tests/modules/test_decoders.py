import pytest
import torch
from torch import nn

from hdrqn_torchrl.modules import CellDecoder, CodeDecoder, ImageDecoder, VectorDecoder
from hdrqn_torchrl.modules.decoders import averaged


def test_the_cell_decoder_error_is_the_mean_cross_entropy():
    torch.manual_seed(0)
    decoder = CellDecoder(6, view=3, num_codes=5)
    vector, cells = torch.randn(2, 4, 6), torch.randint(5, (2, 4, 3, 3), dtype=torch.uint8)
    logits = decoder.logits(vector).view(-1, 5)
    expected = nn.functional.cross_entropy(logits, cells.flatten().long(), reduction="none").view(2, 4, 9).mean(-1)
    torch.testing.assert_close(decoder.error(vector, cells), expected)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_the_image_decoder_error_is_that_of_the_coarse_image(dtype):
    """An image of four uniform quarters equals its coarse version."""
    decoder = ImageDecoder(6, channels=2, size=2)
    quarters = torch.tensor([[0, 51], [102, 255]]).expand(2, 2, 2).clone()
    image = quarters.repeat_interleave(4, -1).repeat_interleave(4, -2)
    image = image.to(dtype) if dtype == torch.uint8 else image / 255
    with torch.no_grad():
        decoder.pixels.weight.zero_()
        decoder.pixels.bias.copy_((quarters / 255).flatten())
        assert decoder.error(torch.randn(3, 6), image.expand(3, 2, 8, 8)).tolist() == pytest.approx([0.0] * 3)
        decoder.pixels.bias[0] += 0.4
    error = decoder.error(torch.randn(3, 5, 6), image.expand(3, 5, 2, 8, 8))
    assert error.shape == (3, 5) and error.flatten().tolist() == pytest.approx([0.16 / 8] * 15)


@pytest.mark.parametrize("shape", [(4,), (2, 2), (1, 2, 2)], ids=str)
def test_the_code_decoder_error_is_the_mean_cross_entropy_whatever_the_numbers_of_codes(shape):
    torch.manual_seed(0)
    sizes = (5, 2, 3, 2)
    decoder = CodeDecoder(6, sizes, num_dims=len(shape))
    vector = torch.randn(2, 7, 6)
    codes = torch.stack([torch.randint(size, (2, 7)) for size in sizes], -1)
    ordered = [1, 3, 2, 0]  # by their numbers of codes
    logits = dict(zip(ordered, decoder.logits(vector).split([sizes[entry] for entry in ordered], -1), strict=True))
    entropies = [-logits[entry].log_softmax(-1).gather(-1, codes[..., [entry]]) for entry in range(4)]
    found = decoder.error(vector, codes.view(2, 7, *shape).to(torch.uint8))
    torch.testing.assert_close(found, torch.cat(entropies, -1).mean(-1))


def test_one_code_alone_is_predicted_too():
    decoder = CodeDecoder(6, (4,), num_dims=0)
    assert decoder.error(torch.randn(2, 7, 6), torch.randint(4, (2, 7))).shape == (2, 7)


def test_the_image_decoder_predicts_small_images_as_they_are():
    decoder = ImageDecoder(6, channels=2, size=(3, 5))
    image = torch.rand(4, 2, 3, 5)
    with torch.no_grad():
        decoder.pixels.weight.zero_()
        decoder.pixels.bias.copy_(image[0].flatten())
    assert decoder.error(torch.randn(4, 6), image)[0].item() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("size", [(14, 14), (14, 44), (3, 1), (44, 37)], ids=str)
@pytest.mark.parametrize("lowered", [False, True])
def test_images_are_averaged_as_by_adaptive_pooling_in_any_precision_of_learning(size, lowered):
    images = torch.randint(0, 256, (5, 3, 44, 37)).float()
    with torch.autocast("cpu", torch.bfloat16, enabled=lowered):
        found = averaged(images, size)
    torch.testing.assert_close(found, nn.functional.adaptive_avg_pool2d(images, size), rtol=1e-6, atol=1e-4)


def test_the_vector_decoder_error_is_squared_on_a_logarithmic_scale():
    decoder = VectorDecoder(6, size=3)
    with torch.no_grad():
        decoder.entries.weight.zero_()
        decoder.entries.bias.copy_(torch.tensor([0.0, 1.0, -2.0]))
    vector = torch.tensor([[0.0, torch.e - 1, 1 - torch.e]])
    assert decoder.error(torch.randn(1, 6), vector).tolist() == pytest.approx([1 / 3])
    huge = decoder.error(torch.randn(1, 6), torch.tensor([[1e30, -1e30, 3e38]]))
    assert huge.isfinite().all() and huge < 1e4
