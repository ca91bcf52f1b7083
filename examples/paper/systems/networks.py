"""The networks of the comparison: convolutions before an LSTM, spiking layers, and a residual network with a head.

Each reads a batch of images of one size and gives logits (B, C) of C materials. Streams of any length fit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from scroll_tactile.embeddings.resnet import ResNet
from scroll_tactile.embeddings.vision import to_planes
from scroll_tactile.libraries import optional

__all__ = ["ConvLSTM", "ResNetClassifier", "SpikingNet"]


INSTANTS = 40  # of the spiking network, in a usual touch


class ConvLSTM(nn.Module):
    """Two convolutions along time over all channels, then an LSTM, whose mean output a linear layer reads.

    The arrangement of Taunyazov et al. 2019 (ICRA, Towards effective tactile identification of textures), whose
    figures the paper quotes; the widths are ours.

    channels: of the image (B, channels, T). width: channels of the convolutions; hidden: of the LSTM.
    """

    def __init__(self, channels: int, materials: int, width: int = 64, hidden: int = 128) -> None:
        super().__init__()
        self.front = nn.Sequential(
            nn.BatchNorm1d(channels),
            nn.Conv1d(channels, width, 5, 2, 2, bias=False),
            nn.BatchNorm1d(width),
            nn.ReLU(),
            nn.Conv1d(width, width, 5, 2, 2, bias=False),
            nn.BatchNorm1d(width),
            nn.ReLU(),
        )
        self.lstm = nn.LSTM(width, hidden, batch_first=True)
        self.head = nn.Linear(hidden, materials)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Logits (B, materials) of images (B, channels, T)."""
        outputs, _ = self.lstm(self.front(images).transpose(1, 2))
        logits: torch.Tensor = self.head(outputs.mean(dim=1))
        return logits


class SpikingNet(nn.Module):
    """Two layers of leaky integrate-and-fire neurons (snntorch's `Leaky`), read by their mean rates.

    u_t = β u_{t−1} + I_t − θ s_{t−1},  s_t = [u_t > θ], with a learned β in each layer and a surrogate gradient in
    the place of the step's (arctangent, snntorch's own). The current I is a convolution of the spikes below over a few
    instants, synapses of several delays, brought to a mean and spread by batch normalisation.

    shape: (lines, T) of the usual spike counts, which are averaged over so many instants that about INSTANTS are left:
    each is a step of its own, forwards and back. hidden: neurons of a layer. delays: instants of a convolution.

    Raises InputError where snntorch is missing.
    """

    def __init__(self, shape: tuple[int, ...], materials: int, hidden: int = 128, delays: int = 5) -> None:
        super().__init__()
        leaky = _leaky()
        lines, columns = shape
        self.every = max(1, round(columns / INSTANTS))
        self.currents = nn.ModuleList(
            nn.Sequential(nn.Conv1d(below, hidden, delays, padding=delays // 2, bias=False), nn.BatchNorm1d(hidden))
            for below in (lines, hidden)
        )
        self.neurons = nn.ModuleList(leaky(beta=0.9, learn_beta=True) for _ in range(2))
        self.head = nn.Linear(hidden, materials)

    def forward(self, spikes: torch.Tensor) -> torch.Tensor:
        """Logits (B, materials) of spike counts (B, lines, T)."""
        fired = functional.avg_pool1d(spikes, min(self.every, spikes.shape[-1]))
        for currents, neuron in zip(self.currents, self.neurons, strict=True):
            inflow = currents(fired)
            potential = torch.zeros_like(inflow[..., 0])
            steps = []
            for i in range(inflow.shape[-1]):
                out, potential = neuron(inflow[..., i], potential)
                steps.append(out)
            fired = torch.stack(steps, dim=-1)
        logits: torch.Tensor = self.head(fired.mean(dim=-1))
        return logits


def _leaky() -> Any:
    with optional("snntorch", "spiking", "the spiking network"):
        from snntorch import Leaky
    return Leaky


class ResNetClassifier(nn.Module):
    """A residual network, all of it to be trained, the average of its last maps, and a linear layer.

    net: taken over. Images of any size, (B, C, T) or colour (B, 3, H, W), in [-1, 1]. trained: whether its weights are
    worth keeping; see `prepare`.
    """

    def __init__(self, net: ResNet, materials: int, *, trained: bool = False) -> None:
        super().__init__()
        # The order of the planes is the same arithmetic and an eighth to a third of the time less.
        self.net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.trained = trained
        self.head = nn.Linear(net.widths[-1], materials)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Logits (B, materials)."""
        logits: torch.Tensor = self.head(self.features(images))
        return logits

    def features(self, images: torch.Tensor) -> torch.Tensor:
        """What the linear layer reads, (B, d)."""
        last: torch.Tensor = self.net(to_planes(images))[-1]
        return functional.adaptive_avg_pool2d(last, 1).flatten(1)

    def prepare(self, batches: Iterable[torch.Tensor]) -> None:
        """Prepare for all images that will be learned from; of a trained network the statistics become theirs.

        Batch normalisation trains with the batch's mean μ and deviation σ, and the published ones, μ₀ and σ₀, are of
        photographs, or of nothing where the file has them folded into the slopes: training would begin with another
        network, with maps up to thirty times as large. So slopes and offsets are changed with them,

            γ' = γ σ / σ₀,   β' = β + γ (μ − μ₀) / σ₀,

        and the network gives what it gave before.
        """
        if not self.trained:
            return
        norms = [module for module in self.net.modules() if isinstance(module, nn.BatchNorm2d)]
        sums = {norm: torch.zeros(2, norm.num_features, dtype=torch.float64) for norm in norms}
        counts = dict.fromkeys(norms, 0)

        def add(norm: nn.Module, inputs: tuple[torch.Tensor, ...]) -> None:
            assert isinstance(norm, nn.BatchNorm2d)
            values = inputs[0].double()
            both = torch.stack([values.sum(dim=(0, 2, 3)), values.square().sum(dim=(0, 2, 3))])
            sums[norm] += both.cpu()
            counts[norm] += values.numel() // values.shape[1]

        hooks = [norm.register_forward_pre_hook(add) for norm in norms]
        try:
            self.net.eval()
            with torch.no_grad():
                for images in batches:
                    self.net(to_planes(images))
        finally:
            for hook in hooks:
                hook.remove()
        for norm in norms:
            mean, square = sums[norm] / counts[norm]
            _adopt(norm, mean, (square - mean.square()).clamp(min=0))


def _adopt(norm: nn.BatchNorm2d, mean: torch.Tensor, variance: torch.Tensor) -> None:
    """Give a layer other statistics, and slopes and offsets with which it does the same."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    with torch.no_grad():
        slope = norm.weight.double().cpu() / torch.sqrt(norm.running_var.double().cpu() + norm.eps)
        offset = norm.bias.double().cpu() + slope * (mean - norm.running_mean.double().cpu())
        norm.weight.copy_(slope * torch.sqrt(variance + norm.eps))
        norm.bias.copy_(offset)
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)
