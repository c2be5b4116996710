"""The worker of `edp.sandbox` for logs: ``python -m edp.logs.sandbox_worker``."""

from __future__ import annotations

from edp.logs.served import serve
from edp.sandbox.sandbox_worker import main

if __name__ == "__main__":
    main(serve)
