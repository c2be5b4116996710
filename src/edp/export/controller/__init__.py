"""Controllers as C99 without heap: `write_controller`; `edp.workflows.control` makes its parts of a run."""

from edp.export.controller.parts import AXES as AXES
from edp.export.controller.parts import ControllerParts as ControllerParts
from edp.export.controller.parts import GoldenLoop as GoldenLoop
from edp.export.controller.parts import PilotCommand as PilotCommand
from edp.export.controller.parts import PlanParts as PlanParts
from edp.export.controller.write import write_controller as write_controller
