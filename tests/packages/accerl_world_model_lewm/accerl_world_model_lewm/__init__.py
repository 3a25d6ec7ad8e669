# SPDX-License-Identifier: Apache-2.0
"""LeWM (arXiv 2603.19312) of the package stable-worldmodel, as a world model of accerl_lerobot.

The import of stable-worldmodel itself loads 2,000 modules, environments and databases among them. So only its
folder ``wm`` is made part of this package: ``accerl_world_model_lewm.lewm`` and ``.loss`` are its files.
"""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.world_model.config import StateModelConfig

installed = find_spec("stable_worldmodel")
if installed is not None and installed.origin is not None:
    __path__.append(str(Path(installed.origin).parent / "wm"))


@StateModelConfig.register_subclass("lewm")
@dataclass(frozen=True, kw_only=True)
class LeWMConfig(StateModelConfig):
    """The embedding of a LeWM that learns during the run; the default sizes train on a CPU.

    Published models have 224 pixels, patches of 14, width 192 and 12 layers.
    """

    make = "accerl_world_model_lewm.model:LeWMState"

    path: str | None = None
    """Weights to start from: the state dict of a LeWM of these sizes, as safetensors. It sees one camera."""
    image_size: Annotated[int, Range("[8, 1024]")] = 64
    """Height and width in pixels that images are resized to; a multiple of `patch_size`."""
    patch_size: Annotated[int, Range("[1, 64]")] = 8
    """Height and width in pixels of a patch."""
    width: Annotated[int, Range("[64, 4096]")] = 64
    """Numbers of an embedding and of a token; a multiple of 64."""
    layers: Annotated[int, Range("[1, 100]")] = 4
    """Layers of the encoder."""
    learning_rate: Annotated[float, Range("(0, 1]")] = 5e-4
    """Learning rate; that of the published models is 5e-5."""
