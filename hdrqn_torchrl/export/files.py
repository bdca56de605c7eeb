"""Files of a decision: written for other programs, and read back."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

from hdrqn_torchrl import __version__
from hdrqn_torchrl.export.operations import for_onnx
from hdrqn_torchrl.export.step import NEXT, DecisionStep, name_of
from hdrqn_torchrl.runs.persistence.files import replaced

ENDINGS = (".onnx", ".pt2")
ABOUT = "hdrqn_torchrl"
"""Name of the JSON text in a file that says what its inputs are."""
_PACKAGES = ("onnx", "onnxscript", "onnxruntime")

Decide = Callable[[Mapping[str, Tensor]], dict[str, Tensor]]


def check_file(path: Path) -> None:
    """Refuses a file of another ending, or one whose packages are missing.

    Raises:
        ValueError: naming what to do.

    Examples:
        >>> check_file(Path("agent.pt2"))
    """
    if path.suffix not in ENDINGS:
        raise ValueError(f"out must end in {' or '.join(ENDINGS)}, got {str(path)!r}.")
    missing = [name for name in _PACKAGES if find_spec(name) is None]
    if path.suffix == ".onnx" and missing:
        raise ValueError(
            f"out=*.onnx needs {', '.join(missing)}: pip install 'hdrqn_torchrl[export]', or write a .pt2, which needs "
            "PyTorch alone."
        )


def export_step(step: DecisionStep, path: str | Path) -> None:
    """Writes a decision to a file, which is either whole or the one before.

    The first dimension of all inputs may have any size. Names of subgoals and of the parts of the state are in the
    file: in an ONNX file as ``hdrqn_torchrl`` among its metadata, in a ``.pt2`` file as ``hdrqn_torchrl.json``.

    Args:
        step: the decision, whose module is in evaluation mode afterwards.
        path: the file, ``.onnx`` or ``.pt2``.

    Raises:
        ValueError: see :func:`check_file`.

    Examples:
        >>> import tempfile
        >>> from hdrqn_torchrl.algorithms import make_drqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> agent = make_drqn(env, compact_network(8, (8,)))
        >>> step, path = DecisionStep(agent, agent.transform(env)), Path(tempfile.mkdtemp()) / "agent.pt2"
        >>> export_step(step, path)
        >>> load_step(path)(step.example())["action"].shape
        torch.Size([2])
    """
    path = Path(path)
    check_file(path)
    example = step.eval().example()
    batch = Dim("batch")
    shapes = {name: {0: batch} for name in example}
    with torch.no_grad(), _quiet():
        program = torch.export.export(step, (example,), dynamic_shapes=(shapes,), strict=False)
        about = json.dumps(describe(step))
        with replaced(path) as partial:
            if path.suffix == ".pt2":
                torch.export.save(program, partial, extra_files={f"{ABOUT}.json": about})
            else:
                _save_onnx(program, example, list(step(example)), about, partial)


def _save_onnx(
    program: ExportedProgram, example: dict[str, Tensor], outputs: list[str], about: str, path: Path
) -> None:
    program.graph_module.graph.eliminate_dead_code()
    made = torch.onnx.export(
        for_onnx(program),
        (example,),
        dynamo=True,
        verbose=False,
        input_names=list(example),
        output_names=outputs,
    )
    assert made is not None
    made.model.metadata_props[ABOUT] = about
    made.save(path, external_data=False)


def describe(step: DecisionStep) -> dict[str, Any]:
    """What another program needs to know: the inputs, which of them are the state, the task's numbers of the actions,
    what subgoals are called."""
    names = {level.choice_key: list(level.choice_names) for level in step.levels if level.init_key is not None}
    return {
        "version": __version__,
        "observed": [name_of(key) for key in step.observed],
        "state": [part.name for part in step.carried],
        "next": NEXT,
        "actions": list(step.action_numbers),
        "subgoals": {part.name: names[part.after] for part in step.carried if part.after in names},
    }


def load_step(path: str | Path) -> Decide:
    """A decision read back from its file, as a function of tensors by name.

    Args:
        path: what :func:`export_step` wrote.

    Raises:
        ValueError: see :func:`check_file`.

    Examples:
        >>> import tempfile
        >>> from hdrqn_torchrl.algorithms import make_drqn
        >>> from hdrqn_torchrl.envs import MultiGoalGridEnv
        >>> from hdrqn_torchrl.modules import compact_network
        >>> env = MultiGoalGridEnv(num_envs=2)
        >>> agent = make_drqn(env, compact_network(8, (8,)))
        >>> step, path = DecisionStep(agent, agent.transform(env)), Path(tempfile.mkdtemp()) / "agent.pt2"
        >>> export_step(step, path)
        >>> decide = load_step(path)
        >>> list(decide(step.example()))
        ['action', 'action_value', 'next_sub_hidden', 'next_sub_cell']
    """
    path = Path(path)
    check_file(path)
    return _load_program(path) if path.suffix == ".pt2" else _load_onnx(path)


def _load_program(path: Path) -> Decide:
    module = torch.export.load(path).module()
    return lambda inputs: module(dict(inputs))


def _load_onnx(path: Path) -> Decide:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names, outputs = [each.name for each in session.get_inputs()], [each.name for each in session.get_outputs()]

    def decide(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = session.run(None, {name: inputs[name].numpy() for name in names})
        return {name: torch.from_numpy(value) for name, value in zip(outputs, found, strict=True)}

    return decide


@contextmanager
def _quiet() -> Iterator[None]:
    """Leaves out what the exporter says about packages that nothing here needs."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
