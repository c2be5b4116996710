"""What workers of these tests are told to do."""

import os
import signal
from pathlib import Path

from edp.errors import DataError
from edp.storage.ledger import WithState


def square(identity, where):
    """The square of a number, and a line in a log for each start."""
    number = identity.config["number"]
    with Path(where["log"]).open("a") as log:
        log.write(f"{number}\n")
    if number == identity.config.get("killed") and not Path(where["log"] + ".killed").exists():
        Path(where["log"] + ".killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if number == identity.config.get("dies"):
        os._exit(3)
    if number == identity.config.get("broken"):
        raise KeyError(number)
    if number == identity.config.get("refused"):
        raise DataError("a log of row 7 is no log")
    return WithState({"square": number**2}, b"%d" % number)
