import math

import pytest
import torch
from helpers import build, collect, small_env, tiny_settings
from tensordict import TensorDict

from hdrqn_torchrl.learning import PhaseOne, Phases
from hdrqn_torchrl.modules import EpsilonGreedy, SuccessEpsilonGreedy


def options(*reached):
    """A batch of options of one step for both of two subgoals."""
    reached = torch.tensor(reached).repeat_interleave(2)
    step = {
        "active_subgoal": torch.arange(2).repeat(len(reached) // 2)[None],
        "option_done": torch.ones(1, len(reached), 1, dtype=torch.bool),
        "subgoal_reached": reached[None, :, None],
        "attained": torch.eye(2, dtype=torch.bool).repeat(len(reached) // 2, 1)[None] & reached[None, :, None],
    }
    init = torch.arange(len(reached)).view(1, -1, 1) == 0
    root = {"is_init": init, "option_init": torch.ones_like(init), "attained": torch.zeros(1, len(reached), 2).bool()}
    root["subgoal_mask"] = torch.ones(1, len(reached), 2, dtype=torch.bool)
    return TensorDict({**root, "next": step}, [1, len(reached)])


class TestPhases:
    def make(self, **settings):
        exploration = EpsilonGreedy(1.0, 0.1, anneal_frames=10)
        return Phases(PhaseOne(**settings), 2, [exploration], []), exploration

    def test_the_first_phase_ends_when_every_subgoal_is_reached_often_enough(self):
        phases, _ = self.make(success=0.75, min_options=4)
        for reached, phase in (((True, True), 1), ((False, False), 1), ((True,) * 4, 2)):
            assert phases.phase == 1
            phases.observe(options(*reached))
            assert phases.phase == phase
        phases.observe(options(False, False, False, False))
        assert phases.phase == 2  # it does not come back

    def test_the_first_phase_ends_after_its_frames_in_any_case(self):
        phases, _ = self.make(max_frames=4)
        phases.observe(options(False))
        assert phases.phase == 1
        phases.observe(options(False))
        assert phases.phase == 2

    def test_epsilon_stands_still_in_the_first_phase(self):
        phases, exploration = self.make(max_frames=4)
        exploration.step(5)
        assert exploration.epsilon == 1.0
        phases.observe(options(False, False))
        exploration.step(5)
        assert exploration.epsilon.item() == pytest.approx(0.55)

    def test_a_restored_phase_goes_on(self):
        phases, _ = self.make(max_frames=4)
        phases.observe(options(True, False))
        other, exploration = self.make(max_frames=4)
        other.load_state_dict(phases.state_dict())
        assert (other.phase, other.frames, other.success.rates.tolist()) == (2, 4, [0.5, 0.5])
        assert not exploration.held

    def test_metrics_hold_phase_and_success(self):
        phases, _ = self.make()
        assert math.isnan(phases.metrics()["phase/success_1"])  # no option has ended yet
        phases.observe(options(True, False))
        metrics = phases.metrics()
        assert metrics["phase"] == 1 and metrics["phase/success_1"] == 0.5
        phases.clear()
        assert phases.metrics() == metrics  # neither to look nor a new row takes anything away

    def test_the_meta_level_must_choose_at_random(self):
        with pytest.raises(ValueError, match=r"meta_exploration\.start must be 1\.0 with phase_one, got 0\.5"):
            Phases(PhaseOne(), 2, [EpsilonGreedy(0.5)], [])
        message = "middle_exploration must choose at random with phase_one, got SuccessEpsilonGreedy"
        with pytest.raises(ValueError, match=message):
            Phases(PhaseOne(), 2, [SuccessEpsilonGreedy(1.0), EpsilonGreedy(1.0)], [])

    @pytest.mark.parametrize(
        "settings", [{"success": 0.0}, {"success": 1.1}, {"max_frames": 0}, {"min_options": 0}, {"window": 0}], ids=str
    )
    def test_settings_out_of_range_are_refused(self, settings):
        (name,) = settings
        with pytest.raises(ValueError, match=f"{name} must .*, got {settings[name]}; "):
            PhaseOne(**settings)


@pytest.mark.parametrize(("name", "expected"), [("v2", [0, 0, 10]), ("v3", [10, 20, 30])])
def test_algorithms_have_phases_on_request(name, expected):
    env = small_env()
    assert build(name, env, settings=tiny_settings()).monitors == {}
    algorithm = build(name, env, settings=tiny_settings(), phase_one=PhaseOne(max_frames=200))
    (batch,) = collect(algorithm, env, 40)  # 160 frames, 10 updates
    meta, due = algorithm.learners["joint" if name == "v3" else "meta"], []
    for _ in range(3):
        meta.store(batch)
        algorithm.monitors["phases"].observe(batch)  # ends phase one at the second time
        due.append(meta.updates_due())
    assert due == expected  # a meta level of its own does not make up for what it missed
