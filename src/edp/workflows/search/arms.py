"""Arms of a search: settings of the networks and trainings that it compares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from edp.config.experiment import Experiment, build, merged, plain_tree


@dataclass(frozen=True)
class Arm:
    """Settings of a network and its training, as plain tables that are part of the keys of trainings.

    An arm never changes: what replaces a value returns another arm. A path consists of keys that are joined by points,
    such as ``model.backbone.units``.

    Attributes:
        tables: of an experiment, or of a part of one, such as a block.
    """

    tables: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_experiment(experiment: Experiment) -> Arm:
        """Return the settings of an experiment without the values that a request determines.

        Equal requests then have equal keys.
        """
        tables = plain_tree(experiment)
        del tables["split"], tables["judge"]["baselines"]
        # Orders decide these; left in the settings they would make equal trainings different.
        for name in ("epochs", "updates", "patience", "refit", "seed"):
            del tables["training"][name]
        return Arm(tables)

    def __getitem__(self, path: str) -> Any:
        """Return the value or table at a path."""
        value: Any = self.tables
        for key in path.split("."):
            value = value[key]
        return value

    def get(self, path: str, default: Any = None) -> Any:
        """Return the value at a path, or a default if there is none."""
        try:
            return self[path]
        except KeyError:
            return default

    def __contains__(self, path: str) -> bool:
        return self.get(path, self) is not self

    def with_value(self, path: str, value: object) -> Arm:
        """Return an arm with another value at a path."""
        key, _, rest = path.partition(".")
        inner = Arm(self.tables.get(key, {})).with_value(rest, value).tables if rest else value
        return Arm({**self.tables, key: inner})

    def merged(self, change: Mapping[str, object]) -> Arm:
        """Return an arm with tables laid over these; see `edp.settings.tree.merged`."""
        return Arm(merged(self.tables, change))

    def experiment(self, where: str = "of a search") -> Experiment:
        """Return the experiment, which messages call `where`.

        Raises:
            ConfigError: settings that make no experiment.
        """
        return build(Experiment, self.tables, where)
