"""Exports Depth Any Panoramas (DAP) to ONNX, from a checkout of its published code and its published weights.

    python export_onnx.py --code DAP --weights model.pth --output DAP.onnx

It is to be run in the environment of that code, not in PanoLOG's: it imports the network from the checkout.
All that it relies on there is `networks.models.make(model)`, which the code's own `test/infer.py` calls with
the entry `model` of `config/infer.yaml`, and a dictionary of outputs with `pred_depth` and `pred_mask`.
"""

import argparse
import os
import sys
from pathlib import Path

import torch
import yaml
from torch import Tensor, nn

HEIGHT, WIDTH = 512, 1024
OUTPUTS = ("pred_depth", "pred_mask")


class Maps(nn.Module):
    """The network with its two maps as a tuple of fixed order, which is what ONNX has."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """(1, 3, 512, 1024) RGB in [0, 1] to depth / 100 metres and to sky, each (1, 1, 512, 1024)."""
        found = self.network(image)
        return tuple(found[name].float() for name in OUTPUTS)


def load(code: Path, weights: Path) -> nn.Module:
    """The network of the checkout `code` with its weights; every weight must find its place."""
    os.chdir(code)  # the code finds its backbone relative to itself
    sys.path.insert(0, str(code))
    from networks.models import make  # noqa: PLC0415  # only there once the checkout is on the path

    config = yaml.safe_load((code / "config" / "infer.yaml").read_text())
    network: nn.Module = make(config["model"])
    state = torch.load(weights, map_location="cpu", weights_only=True)
    state = {key.removeprefix("module."): value for key, value in state.items()}
    missing = network.load_state_dict(state, strict=False)
    if missing.missing_keys:
        sys.exit(
            f"{weights}: {len(missing.missing_keys)} weights are missing, such as {missing.missing_keys[0]}"
        )
    return network.eval()


def export(network: nn.Module, output: Path) -> None:
    """Writes the ONNX file, and next to it a file of weights, if they are too large for one ONNX file."""
    torch.onnx.export(
        Maps(network),
        (torch.rand(1, 3, HEIGHT, WIDTH),),
        str(output),
        input_names=["image"],
        output_names=list(OUTPUTS),
        opset_version=18,
        dynamo=False,  # traced: its size is fixed, and no second package is needed
    )


def compare(network: nn.Module, output: Path) -> float:
    """The largest difference between the network and its export on noise."""
    import onnxruntime  # noqa: PLC0415  # the export itself does without

    image = torch.rand(1, 3, HEIGHT, WIDTH)
    session = onnxruntime.InferenceSession(str(output), providers=["CPUExecutionProvider"])
    exported = session.run(list(OUTPUTS), {"image": image.numpy()})
    with torch.inference_mode():
        own = Maps(network)(image)
    return max(float((torch.from_numpy(a) - b).abs().max()) for a, b in zip(exported, own, strict=True))


def main() -> None:
    """The program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--code", type=Path, required=True, help="checkout of the published code")
    parser.add_argument("--weights", type=Path, required=True, help="model.pth as published")
    parser.add_argument("--output", type=Path, default=Path("DAP.onnx"))
    parser.add_argument("--compare", action="store_true", help="run both and compare; needs onnxruntime")
    arguments = parser.parse_args()
    output = arguments.output.resolve()
    with torch.no_grad():
        network = load(arguments.code.resolve(), arguments.weights.resolve())
        export(network, output)
    print(f"{output}: {output.stat().st_size / 2**20:.0f} MiB")
    if arguments.compare:
        print(f"largest difference to the network itself: {compare(network, output):.2g}")


if __name__ == "__main__":
    main()
