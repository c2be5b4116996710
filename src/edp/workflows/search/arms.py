"""Arms of a search: settings of the networks and trainings that it compares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from edp.config.experiment import Experiment, build, merged, plain_tree
from edp.settings.tree import value_at, with_value


@dataclass(frozen=True)
class Arm:
    """Settings of a network and its training, as plain tables that are part of the keys of trainings.

    An arm never changes: what replaces a value returns another arm. A path consists of keys that are joined by points,
    such as ``model.backbone.units``.

    Attributes:
        tables: tables of a settings file of an experiment.
    """

    tables: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_experiment(experiment: Experiment) -> Arm:
        """Return the settings of an experiment without the values that a request determines.

        Equal requests then have equal keys.
        """
        tables = plain_tree(experiment)
        del tables["split"], tables["evaluation"]["baselines"]
        # Orders decide these; left in the settings they would make equal trainings different.
        for name in ("epochs", "updates", "patience", "refit", "seed"):
            del tables["training"][name]
        return Arm(tables)

    def __getitem__(self, path: str) -> Any:
        """Return the value or table at a path."""
        if path not in self:
            raise KeyError(path)
        return self.get(path)

    def get(self, path: str, default: Any = None) -> Any:
        """Return the value at a path, or a default if missing."""
        return value_at(self.tables, path, default)

    def __contains__(self, path: str) -> bool:
        return self.get(path, self) is not self

    def with_value(self, path: str, value: object) -> Arm:
        """Return an arm with another value at a path."""
        return Arm(with_value(self.tables, path, value))

    def merged(self, change: Mapping[str, object]) -> Arm:
        """Return an arm with tables laid over these; see `edp.settings.tree.merged`."""
        return Arm(merged(self.tables, change))

    def experiment(self, where: str = "of a search") -> Experiment:
        """Return the experiment, which messages call `where`.

        Raises:
            ConfigError: settings that make no experiment.
        """
        return build(Experiment, self.tables, where)
