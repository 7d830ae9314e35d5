"""Resources of every asset and op; a run's configuration may override each of their fields."""

from typing import Any

from assets.workspace import Workspace

RESOURCES: dict[str, Any] = {"workspace": Workspace.configure_at_launch()}
