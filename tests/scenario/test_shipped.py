"""Files that come with the library are found by their names."""

import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_dae import shipped_model
from drake_dae.errors import ModelError


def test_a_model_is_found_by_its_name():
    plant = MultibodyPlant(0.0)
    (arm,) = Parser(plant).AddModels(str(shipped_model("two_link_arm.urdf")))
    assert plant.GetModelInstanceName(arm) == "two_link_arm"


def test_a_name_that_is_none_is_reported_with_those_that_are():
    with pytest.raises(ModelError, match=r"two_link_arm\.urdf"):
        shipped_model("two_link_arm")
