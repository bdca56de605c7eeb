import pytest
import torch
from tensordict import TensorDict

from hdrqn_torchrl.learning.finite import FiniteGuard, NonFiniteError, check_batch

NAN, INF = float("nan"), float("inf")


def watch(guard, place="update 1", *, loss=1.0, first=(0.5, 2.0), second=(3.0,), norm=None):
    gradients = {"first": torch.tensor(first), "second": torch.tensor(second)}
    norm = torch.cat(list(gradients.values())).norm() if norm is None else torch.tensor(norm)
    guard.begin(place)
    return guard.watch(torch.tensor(loss), gradients, norm)


CASES = [
    ({"loss": NAN}, "the loss became nan in update 1"),
    ({"loss": -INF}, "the loss became -inf in update 1"),
    ({"second": (NAN,)}, "the gradient of second became NaN or infinite in update 1"),
    ({"first": (0.5, INF), "second": (NAN,)}, "the gradient of first became NaN or infinite in update 1"),
    ({"first": (3e38, 3e38)}, "the gradient's norm became infinite in update 1"),
]


@pytest.mark.parametrize(("wrong", "message"), CASES)
class TestWhatIsWrong:
    def test_a_fault_is_raised_at_once_on_a_cpu(self, wrong, message):
        with pytest.raises(NonFiniteError, match=f"^{message}$"):
            watch(FiniteGuard(at_once=True), **wrong)

    def test_a_fault_is_raised_by_check_on_a_gpu(self, wrong, message):
        """Other updates before and after it change nothing."""
        guard = FiniteGuard(at_once=False)
        updates = ({"place": "update 0"}, wrong, {"place": "update 2"}, {"loss": NAN})
        assert [watch(guard, **update).item() for update in updates] == [0.0, 1.0, 1.0, 1.0]
        for _ in range(2):
            with pytest.raises(NonFiniteError, match=f"^{message}$"):
                guard.check()


def test_finite_numbers_raise_nothing():
    guard = FiniteGuard(at_once=True)
    assert watch(guard) is None
    guard.check()
    guard = FiniteGuard(at_once=False)
    guard.check()
    for place in range(5):
        assert watch(guard, f"update {place}").item() == 0.0
        guard.check()
    watch(guard, "update 9", loss=NAN)
    with pytest.raises(NonFiniteError, match="in update 9"):
        guard.check()


def test_a_late_check_names_the_update_at_its_next_call(as_on_gpu):
    guard = FiniteGuard(at_once=False)
    for number in range(1, 8):
        watch(guard, f"update {number}", **({"loss": NAN} if number == 7 else {}))
        if number % 2 == 0:
            guard.check_late()
    assert len(guard._places) < 7  # those known to be sound are forgotten
    guard.check_late()
    with pytest.raises(NonFiniteError, match=r"^the loss became nan in update 7$"):
        guard.check_late()


def quiet_batch():
    return TensorDict({"next": {"reward": torch.zeros(2, 5, 1)}}, [2, 5])


class TestCheckBatch:
    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
    @pytest.mark.parametrize("key", ["observation", ("next", "observation"), ("next", "reward"), ("sub_hidden")])
    def test_a_bad_batch_is_refused_with_entry_and_place(self, key, value):
        batch = quiet_batch()
        batch["observation"], batch["next", "observation"] = torch.zeros(2, 2, 5, 3)
        batch["sub_hidden"] = torch.zeros(2, 5, 4)
        check_batch(batch, 50)
        entry = batch[key]
        entry[1, 3, 0] = value
        name = key if isinstance(key, str) else ".".join(key)
        with pytest.raises(NonFiniteError, match=f"^{name} holds a NaN or an infinity, environment 1, after frame 50$"):
            check_batch(batch, 50)

    def test_the_observation_is_named_before_entries_that_follow_from_it(self):
        batch = quiet_batch()
        batch["a"], batch["observation"] = torch.full((2, 2, 5), float("nan"))
        with pytest.raises(NonFiniteError, match=r"^observation holds"):
            check_batch(batch, 0)

    def test_integers_and_flags_are_ignored(self):
        batch = quiet_batch()
        batch["observation"] = torch.full((2, 5, 3), 255, dtype=torch.uint8)
        check_batch(batch, 0)
