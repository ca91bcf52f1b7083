"""What several tests of the studies share."""

import pytest
import torch

from scroll_tactile.embeddings.resnet import ResNet


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file of a ResNet's random weights."""
    path = tmp_path_factory.mktemp("weights") / "random.pth"
    torch.save(ResNet.random(3).state_dict(), path)
    return str(path)
