# SPDX-License-Identifier: Apache-2.0
"""The weights of a file are in the memory of a process once, however many parts of the SLAM use them."""

from __future__ import annotations

import copy
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dpm2_core.errors import UsageError
from dpm2_core.frame import Frame
from dpm2_core.network import weights as weights_module
from dpm2_core.network.model import DeepPointMap2
from dpm2_core.network.perception import dynamic_objects
from dpm2_core.network.pretrained import PRETRAINED_DIR, load_network, load_once, weights_id
from dpm2_core.network.weights import save_weights
from dpm2_core.slam.build import make_slam
from dpm2_core.slam.session import open_for_localization, open_session
from dpm2_core.slam.settings import SlamSettings

from ...helpers.networks import tiny
from ...helpers.scenes import boxes


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each safetensors file has been opened."""
    count: Counter[str] = Counter()
    really = weights_module.safe_open

    def counted(path: Path, *arguments: Any) -> Any:
        count[Path(path).name] += 1
        return really(path, *arguments)

    monkeypatch.setattr(weights_module, "safe_open", counted)
    return count


@pytest.fixture
def network_file(model: DeepPointMap2, tmp_path: Path) -> Path:
    """Weights of the tiny network."""
    save_weights(model, tmp_path / "tiny.safetensors", {})
    return tmp_path / "tiny.safetensors"


@pytest.mark.slow
def test_a_run_with_every_part_that_has_a_network_opens_each_file_once(
    network_file: Path, tmp_path: Path, opened: Counter[str],
    noise: np.random.Generator,
) -> None:  # fmt: skip
    """Refined registration, loops by descriptors and a filter make a map; the same settings localize in it."""
    filter_file = tmp_path / "filter.safetensors"
    shutil.copy(PRETRAINED_DIR / "movers.safetensors", filter_file)
    settings = SlamSettings.model_validate({
        "registration": "refined", "threads": torch.get_num_threads(), "loops": {"descriptors": True},
        "neural": {"weights": str(network_file)}, "filter": {"kind": "movers", "weights": filter_file},
    })  # fmt: skip
    points = np.column_stack([boxes(noise), np.full(4000, 0.5)]).astype(np.float32)
    with open_session(tmp_path / "a.dpm2map", settings, "", resume=False) as store:
        made = make_slam(settings, store=store)
        for number in range(2):
            made.process(Frame(number * 10**8, points))
        made.finish()
    with open_for_localization(tmp_path / "a.dpm2map", settings) as store:
        make_slam(settings, store=store).process(Frame(0, points))
    assert opened == {"tiny.safetensors": 1, "filter.safetensors": 1}


def test_a_file_that_changed_is_loaded_again(network_file: Path, model: DeepPointMap2, opened: Counter[str]) -> None:
    """A changed file is loaded again; networks that are already in use do not change."""
    one, same = load_network(str(network_file), 1), load_network(str(network_file), 1)
    with torch.no_grad():
        next(model.parameters()).add_(1)
    save_weights(model, network_file, {})
    os.utime(network_file, ns=(1, 1))
    changed = load_network(str(network_file), 1)
    values = [next(network.parameters()) for network in (one, same, changed)]
    assert values[0] is values[1]
    assert not torch.equal(values[0], values[2])
    assert opened["tiny.safetensors"] == 2


def test_a_link_to_the_file_and_a_relative_path_are_the_same_file(
    network_file: Path, opened: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(network_file.parent)
    Path("link.safetensors").symlink_to(network_file)
    for name in (str(network_file), "tiny.safetensors", "link.safetensors"):
        load_network(name, 1)
    assert opened.total() == 1


def test_what_one_user_registered_to_is_not_given_to_another(network_file: Path, noise: np.random.Generator) -> None:
    """A network caches its part of the work on the last target; the SLAM has one network per thread."""
    one, other = load_network(str(network_file), 1), load_network(str(network_file), 1)
    assert one is not other
    assert next(one.parameters()) is next(other.parameters())


def test_weights_of_another_network_are_rejected_though_the_file_is_loaded(network_file: Path) -> None:
    """A network from one loader is not returned by another loader."""
    load_network(str(network_file), 1)
    with pytest.raises(UsageError, match="not of movers"):
        load_once(network_file, 1, dynamic_objects.load)
    with pytest.raises(UsageError, match=r"none\.safetensors: No such file"):
        load_once(network_file.parent / "none.safetensors", 1, dynamic_objects.load)


@pytest.mark.slow
@pytest.mark.skipif(torch.__version__.startswith("2.6."), reason="that version imports them for any weights")
def test_loading_does_not_import_the_compiler_of_torch() -> None:
    """torch._dynamo and sympy would add 2 s to the start of every node and command with a network."""
    program = (
        "import sys; from dpm2_core.network.pretrained import load_network; load_network('small', 1); "
        "sys.exit(', '.join({'torch._dynamo', 'sympy'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_a_map_outlives_another_decoder_and_not_another_encoder(model: DeepPointMap2, tmp_path: Path) -> None:
    """A new decoder does not change the descriptors, so that maps with them stay valid; previously, such maps counted
    as made with other weights."""
    file = tmp_path / "tiny.safetensors"
    save_weights(model, file, {})
    before = weights_id(str(file))
    for part in ("decoder", "encoder"):
        changed = copy.deepcopy(model)
        with torch.no_grad():
            next(changed.get_submodule(part).parameters()).add_(1.0)
        save_weights(changed, file, {"steps": "more"})
        assert (weights_id(str(file)) == before) == (part == "decoder")


def test_the_encoder_of_another_network_is_another_one(tmp_path: Path) -> None:
    """If the settings for processing a scan differ, the encoder counts as another one, even with the same tensors."""
    torch.manual_seed(0)
    network, file = DeepPointMap2(tiny()), tmp_path / "tiny.safetensors"
    save_weights(network, file, {})
    before = weights_id(str(file))
    network.settings = tiny().model_copy(update={"points": tiny().points.model_copy(update={"far": 55.0})})
    save_weights(network, file, {})
    assert weights_id(str(file)) != before


def test_what_is_no_weights_has_no_descriptors(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no weights, and long enough for a header")
    with pytest.raises(UsageError, match="text: not weights"):
        weights_id(str(tmp_path / "text"))
