# SPDX-License-Identifier: Apache-2.0
"""The state of critic and teacher from LeWM's embedding.

    image o ──ViT──► z ──with chunk──► predicted z'
    image o'──ViT──► z'                   mean (predicted z' − z')² + 0.09 · SIGReg(z, z')

Loss, weights and sizes that no option names are those of LeWM's own training script. A decision is a step of
LeWM, and the executed chunk is its block of actions.

Shapes: B decisions, H × W pixels, K executed actions of A dims, S numbers of a state.
"""

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn
from torch.nn import functional
from transformers import ViTConfig, ViTModel

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.states import StateModel

try:
    from accerl_world_model_lewm.lewm import LeWM
    from accerl_world_model_lewm.lewm.module import MLP, Embedder, Predictor
    from accerl_world_model_lewm.loss import SIGReg
except ModuleNotFoundError as error:
    hint = "it is a model of another package: pip install --no-deps stable-worldmodel==0.1.1"
    raise InputError("world_model.type", "lewm", hint) from error

SIGREG = 0.09  # weight of the regulariser
HEAD = 64  # width of an attention head
STATE = "observation.state"
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's pixels


class LeWMState(StateModel):
    """Its states are the embedding, proprioception, and the share of the time limit gone."""

    def __init__(self, spec, config):
        super().__init__()
        if set(spec.cameras.values()) != {3}:
            raise InputError("world_model.type", config.type, "it sees colour images, and nothing else")
        if config.width % HEAD:
            raise InputError("world_model.width", config.width, f"use a multiple of {HEAD}")
        if config.image_size % config.patch_size:
            hint = f"use a multiple of world_model.patch_size={config.patch_size}"
            raise InputError("world_model.image_size", config.image_size, hint)
        self.cameras, self.pixels, self.numbers = tuple(spec.cameras), config.image_size, spec.state
        self.size = config.width + spec.state + 1
        self.learning_rate = config.learning_rate
        width, actions = config.width, spec.chunk[0] * spec.chunk[1]
        vit = ViTConfig(
            image_size=config.image_size,
            patch_size=config.patch_size,
            num_channels=3 * len(self.cameras),
            hidden_size=width,
            intermediate_size=4 * width,
            num_hidden_layers=config.layers,
            num_attention_heads=width // HEAD,
        )
        predictor = {"num_frames": 3, "depth": 6, "heads": 16, "mlp_dim": 2048, "dropout": 0.1}
        projector = {"hidden_dim": 2048, "output_dim": width, "norm_fn": nn.BatchNorm1d}
        self.lewm = LeWM(
            encoder=ViTModel(vit, add_pooling_layer=False),
            predictor=Predictor(input_dim=width, hidden_dim=width, **predictor),
            action_encoder=Embedder(input_dim=actions, emb_dim=width),
            projector=MLP(width, **projector),
            pred_proj=MLP(width, **projector),
        )
        self.sigreg = SIGReg()
        if config.path is not None:
            self._load(config.path)

    def encode(self, observations, tasks, elapsed):
        embedding = self.lewm.encode({"pixels": self._images(observations)[:, None]})["emb"][:, 0]
        late = torch.from_numpy(elapsed.astype(np.float32))[:, None].to(embedding)
        numbers = embedding.new_zeros(len(embedding), 0)
        if self.numbers:
            rows = observations[STATE]
            numbers = torch.from_numpy(rows.reshape(len(rows), -1)).to(embedding)
        return torch.cat([embedding, numbers, late], 1)

    def loss(self, transitions):
        seen = [self._images(part) for part in (transitions.observations, transitions.following)]
        chunk = transitions.chunk.flatten(1)[:, None]
        made = self.lewm.encode({"pixels": torch.stack(seen, 1), "action": chunk})
        predicted = self.lewm.predict(made["emb"][:, :1], made["act_emb"])
        prediction = functional.mse_loss(predicted, made["emb"][:, 1:])
        sigreg = self.sigreg(made["emb"].transpose(0, 1))
        metrics = {"prediction": float(prediction.detach()), "sigreg": float(sigreg.detach())}
        return prediction + SIGREG * sigreg, metrics

    def _images(self, observations):
        """Float (B, 3 · cameras, H, W), in ImageNet's units; of several env steps the newest."""
        device = self.sigreg.t.device
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (MEAN, STD))
        size = (self.pixels, self.pixels)
        cameras = []
        for name in self.cameras:
            pixels = observations[name]
            newest = np.ascontiguousarray(pixels if pixels.ndim == 4 else pixels[:, -1])
            image = torch.from_numpy(newest).to(device).permute(0, 3, 1, 2) / 255
            if image.shape[-2:] != size:
                image = functional.interpolate(image, size, mode="bilinear", antialias=True)
            cameras.append((image - mean) / std)
        return torch.cat(cameras, 1)

    def _load(self, path):
        """Read weights; the encoder of actions stays untrained if those were of other actions."""
        try:
            weights = load_file(path)
            action = "action_encoder.patch_embed.weight"
            own = self.lewm.state_dict()
            if weights[action].shape != own[action].shape:
                weights |= {name: own[name] for name in own if name.startswith("action_encoder.")}
            self.lewm.load_state_dict(weights)
        except (OSError, SafetensorError, KeyError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:300]
            raise InputError("world_model.path", path, f"no LeWM of these sizes: {reason}") from error
