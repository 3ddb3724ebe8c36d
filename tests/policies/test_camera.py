"""What pixels mean depends on the camera: a policy learns from no other than its own."""

from types import SimpleNamespace

import pytest
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_policy

import relmm.plugin  # noqa: F401
from relmm.errors import ConfigError
from relmm.features import dataset_features
from relmm.geometry import camera_info


@pytest.mark.parametrize("kind", ["relmm", "relmm_paper", "relmm_single", "relmm_scripted"])
def test_a_dataset_of_another_camera_is_refused_in_lerobots_own_commands(kind: str) -> None:
    """LeRobot makes a policy with the dataset's metadata."""
    meta = SimpleNamespace(features=dataset_features(camera=camera_info("d435")), stats={})
    with pytest.raises(ConfigError, match=r"camera d435 \(.*the policy's is paper \("):
        make_policy(PreTrainedConfig.get_choice_class(kind)(device="cpu"), ds_meta=meta)
    make_policy(PreTrainedConfig.get_choice_class(kind)(device="cpu", camera="d435"), ds_meta=meta)
