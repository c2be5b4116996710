"""Backbone and head: every backbone declares its parts, and every parameter belongs to one of them."""

from edp.networks.decomposition import decompose


def test_every_parameter_belongs_to_one_part(structure, predictor_of):
    predictor = predictor_of(structure)
    found = decompose(predictor)
    assert sorted([*found.encoding, *found.head]) == sorted(name for name, _ in predictor.named_parameters())
    assert set(found.encoding) == {name for name, _ in predictor.named_parameters() if name.startswith("backbone.")}
    assert set(found.last) <= set(found.head)
    assert len(found.last) == 2


def test_parts_come_in_the_order_of_the_computation(predictor_of):
    found = decompose(predictor_of("hybrid"))
    assert list(found.backbone) == ["backbone.encoder", "backbone.recurrent", "backbone.pooling"]
    assert list(decompose(predictor_of("tcn")).backbone) == ["backbone"]
