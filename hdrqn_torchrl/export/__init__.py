"""A trained agent's greedy decision as one file for other programs: ONNX, or a program of ``torch.export``."""

from hdrqn_torchrl.export.agreement import Agreement, agreement_with
from hdrqn_torchrl.export.files import check_file, export_step, load_step
from hdrqn_torchrl.export.step import Carried, DecisionStep

__all__ = ["Agreement", "Carried", "DecisionStep", "agreement_with", "check_file", "export_step", "load_step"]
