"""`rich` under a metric that was trained on generated shapes."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load_file, save_file

from igps.descriptors.rich import rich
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.fitted import WhitenedHead

PRETRAINED = Path(__file__).with_name("pretrained.safetensors")
"""The parameters of `pretrained`, written by training/pretrain.py."""


def pretrained(path: str | Path = PRETRAINED) -> EmbeddedDescriptor:
    """`rich` under a `WhitenedHead`, both trained on generated articulated shapes, in evaluation mode.

    It needs no label of the shapes that it compares. The model card is in the README.

    Args:
        path: of the parameters, as `save_pretrained` wrote them; those that the package ships by default.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it holds other parameters.
    """
    stored = {name: tensor.float() for name, tensor in load_file(path).items()}
    # Fixed layouts have no parameters, their filters none to store.
    descriptor = rich(learnable=any(name.endswith("log_gain") for name in stored))
    module = EmbeddedDescriptor(
        descriptor, WhitenedHead(), name="pretrained", source="rich, trained on generated shapes"
    )
    try:
        module.load_state_dict(stored)
    except RuntimeError as error:
        raise ValueError(f"{path}: expected the parameters of `rich` under a WhitenedHead, got others.") from error
    return module.eval()


def save_pretrained(module: EmbeddedDescriptor, path: str | Path) -> None:
    """Write the parameters of a `rich` under a `WhitenedHead` to a safetensors file, the head in half precision."""
    state = {
        name: (tensor.half() if name.startswith("head.") and tensor.is_floating_point() else tensor).contiguous()
        for name, tensor in module.state_dict().items()
    }
    save_file(state, path)
