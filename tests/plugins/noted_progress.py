"""Progress that keeps what was reported."""

from edp.progress import SilentProgress


class NotedProgress(SilentProgress):
    """Progress whose notes, stages and steps a test reads.

    Attributes:
        notes: sentences.
        stages: name and total of each stage.
        steps: units done of each step.
        pull: called with the units done and the values of each step.
    """

    def __init__(self, pull=lambda done, **values: None):
        self.notes, self.stages, self.steps, self.pull = [], [], [], pull

    def stage(self, name, total=None):
        """Keep the name and total of a stage."""
        self.stages.append((name, total))
        return self

    def step(self, done, **values):
        """Keep a step."""
        self.steps.append(done)
        self.pull(done, **values)

    def note(self, sentence):
        """Keep a note."""
        self.notes.append(sentence)
