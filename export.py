"""Writes one greedy decision of a trained agent as a file for other programs: ONNX, or a program of torch.export."""

from hdrqn_torchrl.cli.export import main

if __name__ == "__main__":
    main()
