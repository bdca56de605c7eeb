import pytest
import torch

from hdrqn_torchrl.modules import CellDecoder, Decoder, ObservationPredictor


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
