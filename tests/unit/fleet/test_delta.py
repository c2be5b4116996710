"""A delta: what a fine-tuning changed, within its bytes, bound to its base, and nothing from damaged files."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from edp.errors import BundleError
from edp.networks.backbones import LstmSpec
from edp.networks.predictor import ModelSpec
from edp.storage import write_bytes
from edp.testing.networks import small_network, small_task
from edp.training.bundle import weights_digest
from edp.training.delta import Scaled, apply_delta, delta_from_bytes, delta_of, read_delta

MODEL, OTHER = (ModelSpec(backbone=LstmSpec(units=units)) for units in (24, 8))


@pytest.fixture(scope="module")
def networks():
    """A network, and one whose matrices differ by changes of rank 2 and some noise."""
    base = small_network(MODEL, small_task(MODEL))
    tuned, draw = copy.deepcopy(base), torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in tuned.parameters():
            if parameter.ndim == 2:
                rows, columns = parameter.shape
                narrow = torch.randn(rows, 2, generator=draw) @ torch.randn(2, columns, generator=draw)
                parameter += 0.05 * narrow + 1e-4 * torch.randn(rows, columns, generator=draw)
            else:
                parameter += 0.05 * torch.randn(parameter.shape, generator=draw)
    return base, tuned


def apart(one, other):
    return max(float((a - b).detach().abs().max()) for a, b in zip(one.parameters(), other.parameters(), strict=True))


def test_a_delta_brings_the_fine_tuned_network_back_within_its_bytes(networks, tmp_path):
    base, tuned = networks
    before = weights_digest(base)
    for most in (12_000, 40_000):
        delta = delta_of(base, tuned, {"machine": "C14 no. 3"}, most)
        write_bytes(tmp_path / "c14.delta", delta.to_bytes())
        assert (tmp_path / "c14.delta").stat().st_size <= most
        again = read_delta(tmp_path / "c14.delta")
        assert again.facts == {"machine": "C14 no. 3"}
        network = apply_delta(base, again)
        assert apart(network, tuned) < {12_000: 1.0, 40_000: 0.02}[most] * apart(base, tuned)
        assert weights_digest(network) == weights_digest(apply_delta(base, delta))
    assert weights_digest(base) == before


def test_more_bytes_bring_it_nearer(networks):
    base, tuned = networks
    far = [apart(apply_delta(base, delta_of(base, tuned, {}, most)), tuned) for most in (8_500, 12_000, 200_000)]
    assert far[0] > far[1] > far[2]


def test_what_did_not_change_takes_no_room(networks):
    base, _ = networks
    delta = delta_of(base, copy.deepcopy(base))
    assert not delta.vectors
    assert not delta.whole
    assert not delta.narrow
    assert weights_digest(apply_delta(base, delta)) == weights_digest(base)


def test_a_delta_of_another_network_is_refused(networks):
    base, tuned = networks
    with pytest.raises(BundleError, match=r"is a change of the network .* give the network that the fleet"):
        apply_delta(tuned, delta_of(base, tuned))
    with pytest.raises(BundleError, match="of the same parts"):
        delta_of(base, small_network(OTHER, small_task(OTHER)))
    with pytest.raises(BundleError, match="do not hold the changed vectors"):
        delta_of(base, tuned, {}, 4_200)


def test_damage_is_one_message(networks, tmp_path):
    data = bytearray(delta_of(*networks).to_bytes())
    data[-9] ^= 1
    cases = {"flipped": bytes(data), "cut": bytes(data[: len(data) // 2]), "empty": b"", "text": b"no delta at all"}
    for name, content in cases.items():
        with pytest.raises(BundleError, match="damaged"):
            delta_from_bytes(content, name)
    with pytest.raises(BundleError):
        read_delta(tmp_path / "absent.delta")
    hostile = delta_of(*networks)
    name = next(iter(hostile.vectors))
    hostile.vectors[name][0] = np.inf
    with pytest.raises(BundleError, match=r"got inf at \(0,\), expected .* finite"):
        delta_from_bytes(hostile.to_bytes(), "hostile")


def test_factors_of_a_product_beyond_the_network_are_refused_before_they_are_multiplied(networks):
    base, tuned = networks
    delta = delta_of(base, tuned, {}, 9_000)
    name = next(iter(delta.narrow))
    long = Scaled.from_matrix(np.ones((1, 1_000_000)))
    hostile = replace(delta, narrow={name: (long, long)})
    with pytest.raises(BundleError, match="in another shape"):
        apply_delta(base, delta_from_bytes(hostile.to_bytes(), "hostile"))
