import warnings

import pytest
import torch
from helpers import ALGORITHMS, build, collect, small_env, tiny_settings
from torch import nn

from hdrqn_torchrl.algorithms import make_v3
from hdrqn_torchrl.devices import is_faster_in_bfloat16, multiplies_bfloat16
from hdrqn_torchrl.learning import precision as precision_module
from hdrqn_torchrl.learning.precision import choose_precision, gains, matrix_products
from hdrqn_torchrl.modules import compact_network, paper_network
from hdrqn_torchrl.modules.q_network import ExactLinear


@pytest.fixture
def hardware(monkeypatch):
    """Sets the kinds of devices that multiply bfloat16, and do so fast."""

    def hardware(*kinds):
        for name in ("multiplies_bfloat16", "is_faster_in_bfloat16"):
            monkeypatch.setattr(precision_module, name, lambda kind: kind in kinds)

    return hardware


LARGE, SMALL = nn.LSTM(4, 128), nn.LSTM(4, 127)


@pytest.mark.parametrize(
    ("unit", "maker", "has", "is_faster"),
    [
        ("amx_bf16", "Intel Xeon", True, True),
        ("avx512_bf16", "AMD EPYC", True, True),
        ("avx512_bf16", "Intel Xeon", True, False),
        ("avx512_f", "AMD EPYC", False, False),
    ],
)
def test_cpus_multiply_bfloat16_with_either_unit_but_intel_s_are_slow_without_amx(
    unit, maker, has, is_faster, monkeypatch
):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {unit: True, "cpu_name": maker})
    assert (multiplies_bfloat16("cpu"), is_faster_in_bfloat16("cpu")) == (has, is_faster)


class TestChoice:
    @pytest.mark.parametrize(
        ("kinds", "network", "chosen"),
        [
            (["cpu"], LARGE, "bf16"),
            (["cpu"], SMALL, "fp32"),
            (["cuda"], LARGE, "fp32"),  # it is on the CPU
            ([], LARGE, "fp32"),
        ],
    )
    def test_auto_takes_bf16_where_hardware_and_network_gain(self, kinds, network, chosen, hardware):
        hardware(*kinds)
        assert choose_precision("auto", network) == chosen

    @pytest.mark.parametrize("wanted", ["fp32", "bf16"])
    def test_an_explicit_precision_is_taken(self, wanted, hardware):
        hardware("cpu")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert choose_precision(wanted, SMALL) == wanted

    def test_bf16_on_a_cpu_that_is_slow_at_it_warns(self, hardware):
        hardware()
        with pytest.warns(
            UserWarning, match="precision='bf16' is slower than float32 on this CPU; use 'auto' or 'fp32'"
        ):
            assert choose_precision("bf16", LARGE) == "bf16"

    def test_bf16_on_a_gpu_that_lacks_it_is_refused(self, hardware):
        hardware("cpu")
        with pytest.raises(ValueError, match=r"precision must be 'fp32' or 'auto' on this device \(meta\), which"):
            choose_precision("bf16", LARGE.to("meta"))

    def test_an_unknown_precision_is_refused(self):
        with pytest.raises(ValueError, match="precision must be 'auto', 'fp32' or 'bf16', got 'fp16'; "):
            choose_precision("fp16", SMALL)

    def test_networks_with_convolutions_or_large_lstms_gain(self):
        env = small_env()
        for name in ALGORITHMS:
            small, large = build(name, env, compact_network()), build(name, env, paper_network())
            assert not any(gains(learner.network) for learner in small.learners.values())
            assert any(gains(learner.network) for learner in large.learners.values())
        learner = tiny_settings(sampling="episode_starts")
        assert gains(make_v3(env, compact_network(), learner=learner).policy)
        assert not gains(make_v3(env, compact_network(), learner=learner, memory_size=64).policy)


class TestMatrixProducts:
    @pytest.mark.parametrize(("precision", "dtype"), [("fp32", torch.float32), ("bf16", torch.bfloat16)])
    def test_only_matrix_products_are_lowered(self, precision, dtype):
        with matrix_products(precision, "cpu"):
            assert nn.Linear(2, 3)(torch.ones(1, 2)).dtype == dtype
            assert ExactLinear(2, 3)(torch.ones(1, 2, dtype=dtype)).dtype == torch.float32
        assert not torch.is_autocast_enabled("cpu")

    def test_a_weight_first_read_without_gradient_keeps_its_gradient(self):
        layer = nn.Linear(2, 3)
        with matrix_products("bf16", "cpu"):
            with torch.no_grad():
                layer(torch.ones(1, 2))
            value = layer(torch.ones(1, 2))
        value.sum().backward()
        assert layer.weight.grad is not None and (layer.weight.grad == 1).all()


@pytest.fixture(scope="module", params=[*ALGORITHMS, "v3", "v2-paper"])
def twins(request):
    """Algorithms with the same weights, in both precisions, and a batch."""
    name, _, network = request.param.partition("-")
    architecture = paper_network(8) if network else compact_network(16, (16,))
    made = {}
    for precision in ("fp32", "bf16"):
        torch.manual_seed(0)
        env = small_env(8)
        settings = tiny_settings(precision=precision, batch_size=32, max_grad_norm=10.0, learning_rate=1e-2)
        algorithm = build(name, env, architecture, settings=settings)
        batch = collect(algorithm, env, 20)[0]
        for learner in algorithm.learners.values():
            learner.store(batch)
        made[precision] = algorithm
    return made


def test_losses_and_gradients_are_those_of_fp32_but_for_rounding(twins):
    for level, exact in twins["fp32"].learners.items():
        lower = twins["bf16"].learners[level]
        torch.manual_seed(1)
        sample = exact.sample()
        results = []
        for learner in (exact, lower):
            learner.optimizer.zero_grad()
            with matrix_products(learner.precision, "cpu"):
                result = learner.loss(sample.clone())
            result["loss"].backward()
            assert {value.dtype for value in result.values() if value.is_floating_point()} == {torch.float32}
            gradient = torch.cat([p.grad.flatten() for p in learner.network.parameters()])
            assert gradient.dtype == torch.float32
            results.append((result, gradient))
        (expected, gradient), (found, lowered) = results
        assert found["trained_steps"] == expected["trained_steps"]
        for key in ("loss", "td_error", "q_value", "target"):
            assert found[key].item() == pytest.approx(expected[key].item(), rel=0.05, abs=0.01)
        assert 0 < (lowered - gradient).norm() < 0.1 * gradient.norm()


def test_everything_that_is_kept_is_fp32(twins):
    for learner in twins["bf16"].learners.values():
        metrics = learner.learn()
        kept = [*learner.loss.parameters(), *learner.network.buffers(), *metrics.values()]
        kept += [value for state in learner.optimizer.state.values() for value in state.values()]
        kept += list(learner.sample().values(True, True))
        assert {value.dtype for value in kept if value.is_floating_point()} == {torch.float32}


def test_values_that_differ_by_little_are_not_rounded_to_the_same(twins):
    """Near 1 a bfloat16 has steps of 0.008: greedy choices in learning must not be decided by ties."""
    learner = next(iter(twins["bf16"].learners.values()))
    seen = []
    hooks = [
        layer.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
        for layer in learner.network.modules()
        if isinstance(layer, ExactLinear)
    ]
    with matrix_products("bf16", "cpu"):
        learner.loss(learner.sample())
    for hook in hooks:
        hook.remove()
    assert seen and all(values.dtype == torch.float32 for values in seen)
    assert all((values.bfloat16().float() != values).any() for values in seen)
