"""Students of ensembles: fewer and narrower perceptrons, trained on the outputs of all learners together."""

from __future__ import annotations

import torch

from edp.data.prepared import Prepared
from edp.networks.committee import Committee
from edp.networks.predictor import ModelSpec, Predictor, build_model


def committee_start(teacher: Predictor, model: ModelSpec, data: Prepared, seed: int = 0) -> Predictor | None:
    """Create a student with the teacher's linear model and zero perceptron outputs.

    Args:
        teacher: the committee; another backbone gives None.
        model: the student's settings.
        data: training data.
        seed: seed of the initial weights of the perceptrons.
    """
    if not isinstance(teacher.backbone, Committee):
        return None
    net = build_model(data.task, model, data.scaler(), seed)
    backbone, source = net.backbone, teacher.backbone
    if not isinstance(backbone, Committee):
        return None
    net.front.load_state_dict(teacher.front.state_dict())
    net.code.load_state_dict(teacher.code.state_dict())
    backbone.bank.load_state_dict(source.bank.state_dict())
    heads, taught = net.heads, teacher.heads
    columns = source.bank.columns
    with torch.no_grad():
        heads.weights[0].zero_()
        heads.weights[0][:, :columns] = taught.weights[0][:, :columns]
        heads.biases[0].copy_(taught.biases[0])
        if heads.band is not None and taught.band is not None:
            heads.band.width.copy_(taught.band.width)
    return net
