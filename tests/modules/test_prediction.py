import pytest
import torch
from torch import nn

from hdrqn_torchrl.modules import CellDecoder, ImageDecoder, ObservationPredictor
from hdrqn_torchrl.modules.prediction import Decoder


class TestDecoders:
    def test_the_cell_decoder_error_is_the_mean_cross_entropy(self):
        torch.manual_seed(0)
        decoder = CellDecoder(6, view=3, num_codes=5)
        vector, cells = torch.randn(2, 4, 6), torch.randint(5, (2, 4, 3, 3), dtype=torch.uint8)
        logits = decoder.logits(vector).view(-1, 5)
        expected = nn.functional.cross_entropy(logits, cells.flatten().long(), reduction="none").view(2, 4, 9).mean(-1)
        torch.testing.assert_close(decoder.error(vector, cells), expected)

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
    def test_the_image_decoder_error_is_that_of_the_coarse_image(self, dtype):
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


class Sum(Decoder):
    """Predicts the sum of its vector."""

    def __init__(self, in_features):
        super().__init__()

    def error(self, vector, observation):
        return observation.squeeze(-1) - vector.sum(-1)


def make_predictor(**settings):
    torch.manual_seed(0)
    sizes = {"hidden_size": 3, "num_actions": 2, "max_steps": 3, "width": 4}
    return ObservationPredictor(Sum, **(sizes | settings))


class TestPredictor:
    @pytest.mark.parametrize("ahead", [1, 2, 3])
    def test_a_prediction_depends_on_the_memory_and_the_actions_since(self, ahead):
        predictor = make_predictor()
        memory, action, observation = torch.randn(2, 6, 3), torch.randint(2, (2, 6)), torch.randn(2, 6, 1)
        errors = predictor(memory, action, observation, steps=ahead)
        assert errors.shape == (2, 6 - ahead)
        for row in range(2):
            for t in range(6 - ahead):
                hidden = predictor.memory(memory[row, t]) + predictor.horizon.weight[ahead - 1]
                for place in range(ahead):
                    hidden = hidden + predictor.actions.weight[2 * place + action[row, t + place]]
                expected = observation[row, t + ahead, 0] - hidden.relu().sum()
                torch.testing.assert_close(errors[row, t], expected)

    def test_the_predictor_learns_a_moving_window(self):
        """A pointer walks along a ring; the memory holds its place, and the observation is what lies there."""
        torch.manual_seed(0)
        ring = torch.randint(3, (8,), dtype=torch.uint8)
        predictor = ObservationPredictor(
            lambda size: CellDecoder(size, 1, 3), hidden_size=8, num_actions=2, max_steps=2, width=32
        )
        optimizer = torch.optim.Adam(predictor.parameters(), 1e-2)
        for _ in range(300):
            action = torch.randint(2, (16, 10))
            place = (torch.randint(8, (16, 1)) + (2 * action - 1).cumsum(1) - (2 * action - 1)) % 8
            memory, observation = torch.eye(8)[place], ring[place].view(16, 10, 1, 1)
            loss = sum(predictor(memory, action, observation, steps=steps).mean() for steps in (1, 2))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        assert loss.item() < 0.1

    @pytest.mark.parametrize("name", ["max_steps", "width"])
    def test_wrong_arguments_are_refused(self, name):
        with pytest.raises(ValueError, match=f"{name} must be >= 1, got 0; "):
            make_predictor(**{name: 0})
