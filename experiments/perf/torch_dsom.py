"""The default DSOM and its training step in PyTorch, for comparing speeds; nothing else uses it.

Layouts are PyTorch's own (channels first). What is made without gradients (ray-cast views, polar features, ground
truth) is given, as it is to the step in JAX but for the views, which JAX casts within its step.
"""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import nn

from dsom_jax.nn import DSOMConfig


def block(inputs: int, outputs: int) -> nn.Sequential:
    """3 x 3 convolution, batch norm, ELU."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ELU())


def stack(inputs: int, outputs: list[int]) -> nn.Sequential:
    """Blocks one after the other."""
    sizes = [inputs, *outputs]
    return nn.Sequential(*(block(i, o) for i, o in pairwise(sizes)))


def circular(inputs: int, outputs: int) -> nn.Sequential:
    """Convolution of three neighbours on a circle, batch norm, ELU."""
    conv = nn.Conv1d(inputs, outputs, 3, padding=1, padding_mode="circular", bias=False)
    return nn.Sequential(conv, nn.BatchNorm1d(outputs), nn.ELU())


class TorchDSOM(nn.Module):
    """The polar DSOM with panorama."""

    def __init__(self, config: DSOMConfig, channels_in: int) -> None:
        super().__init__()
        w, k, c = config.width, config.headings, config.channels
        self.k, self.c = k, c
        self.environment = nn.ModuleList([stack(1, [w] * 2), stack(w, [2 * w] * 3), stack(2 * w, [4 * w] * 4)])
        self.project_map = nn.Conv2d(4 * w, k * c, 1)
        self.panorama = nn.Sequential(circular(channels_in - 1, 2 * w), nn.Conv1d(2 * w, c, 1))
        sizes = [(channels_in, 2 * w), (2 * w, 2 * w), (2 * w, 4 * w), (4 * w, 4 * w), (4 * w, 4 * w)]
        self.scan = nn.ModuleList([circular(i, o) for i, o in sizes])
        self.project_scan = nn.Conv1d(4 * w, c, 1)
        self.stages = nn.ModuleList(
            [
                stack(2 * k, [4 * w]),
                stack(4 * w, [4 * w] * 3 + [2 * w]),
                stack(2 * w + k, [2 * w] * 2 + [w]),
                stack(w, [w]),
            ]
        )
        self.head = nn.Conv2d(w, k, 3, padding=1)
        self.sharpness = nn.Parameter(torch.tensor([2.3, 3.4]))

    def encode_scan(self, x: torch.Tensor) -> torch.Tensor:
        """(B, C, A) -> (B, K, K * c)."""
        seen = x[:, 0].reshape(len(x), self.k, -1).mean(-1)
        for number, layer in enumerate(self.scan):
            x = layer(x)
            x = F.max_pool1d(x, 2) if number in (1, 3) else x
        x = (self.project_scan(x) * seen[:, None]).transpose(1, 2)
        source = (torch.arange(self.k)[None, :] - torch.arange(self.k)[:, None] + self.k // 2) % self.k
        return x[:, source].reshape(len(x), self.k, -1)

    def forward(self, occupied: torch.Tensor, views: torch.Tensor, scans: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Maps (N, H, W), views (N, h, w, K, C - 1), scans (N, S, C, A) -> logits and both similarities."""
        n, s = scans.shape[:2]
        x, indices = occupied[:, None], []
        for stage in self.environment:
            x, index = F.max_pool2d(stage(x), 2, return_indices=True)
            indices.append(index)
        features = self.project_map(x)
        scan = F.normalize(self.encode_scan(scans.flatten(0, 1)), dim=-1).reshape(n, s, self.k, -1)
        h, w = views.shape[1:3]
        seen = F.normalize(self.panorama(views.reshape(n * h * w, self.k, -1).transpose(1, 2)), dim=1)
        seen = F.normalize(seen.transpose(1, 2).reshape(n, h * w, -1), dim=-1)
        fine = (scan.reshape(n, s * self.k, -1) @ seen.transpose(1, 2)).reshape(n * s, self.k, h, w)
        fine = fine * self.sharpness[1].exp()
        coarse = scan.reshape(n, s * self.k, -1) @ F.normalize(features, dim=1).flatten(2)
        coarse = coarse.reshape(n * s, self.k, *features.shape[2:]) * self.sharpness[0].exp()
        x = self.stages[0](torch.cat([coarse, F.max_pool2d(fine, 4)], 1))
        for level, index in enumerate(reversed(indices)):
            x = F.max_unpool2d(x, index.repeat_interleave(s, 0), 2)
            x = self.stages[level + 1](torch.cat([x, fine], 1) if level == 1 else x)
        return self.head(x) + F.interpolate(fine, scale_factor=2), fine, coarse


def make_step(config: DSOMConfig, occupied, views, scans, targets, free):
    """A function that makes one step of Adam on the batch: NumPy arrays, targets at the three resolutions."""
    model = TorchDSOM(config, scans.shape[2])
    adam = torch.optim.Adam(model.parameters(), 1e-3)
    data = [torch.from_numpy(a) for a in (occupied, views, scans)]
    truths = [torch.from_numpy(a) for a in targets]
    masks = [torch.from_numpy(a) for a in free]

    def step() -> float:
        adam.zero_grad()
        loss = sum(
            (torch.logsumexp(x := y.masked_fill(~m, -1e9).flatten(1), 1) - (x * t.flatten(1)).sum(1)).mean()
            for y, t, m in zip(model(*data), truths, masks, strict=True)
        )
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        adam.step()
        return float(loss)

    return step


def make_inference(config: DSOMConfig, occupied, views, scan):
    """A function that decodes one scan with the map's features cached, in evaluation mode: a module in parts."""
    model = TorchDSOM(config, scan.shape[1]).eval()
    cached: dict[str, torch.Tensor] = {}

    @torch.inference_mode()
    def once() -> torch.Tensor:
        n, (h, w) = 1, views.shape[1:3]
        if not cached:
            x, indices = torch.from_numpy(occupied)[:, None], []
            for stage in model.environment:
                x, index = F.max_pool2d(stage(x), 2, return_indices=True)
                indices.append(index)
            cached.update({f"index{i}": index for i, index in enumerate(indices)})
            cached["coarse"] = F.normalize(model.project_map(x), dim=1).flatten(2)
            seen = model.panorama(torch.from_numpy(views).reshape(h * w, model.k, -1).transpose(1, 2))
            seen = F.normalize(seen, dim=1).transpose(1, 2).reshape(n, h * w, -1)
            cached["fine"] = F.normalize(seen, dim=-1).transpose(1, 2)
        features = F.normalize(model.encode_scan(torch.from_numpy(scan)), dim=-1)
        fine = (features @ cached["fine"]).reshape(1, model.k, h, w) * model.sharpness[1].exp()
        coarse = (features @ cached["coarse"]).reshape(1, model.k, h // 4, w // 4) * model.sharpness[0].exp()
        x = model.stages[0](torch.cat([coarse, F.max_pool2d(fine, 4)], 1))
        for level in range(3):
            x = F.max_unpool2d(x, cached[f"index{2 - level}"], 2)
            x = model.stages[level + 1](torch.cat([x, fine], 1) if level == 1 else x)
        return torch.log_softmax((model.head(x) + F.interpolate(fine, scale_factor=2)).flatten(), 0)

    return once
