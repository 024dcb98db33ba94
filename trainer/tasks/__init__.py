"""The tasks of networks. A task owns its arrays of the stream, its losses, its films and its scores.

The training loop knows no task by name: a network names its task (``VoxelNetwork.task``), which is registered here.
"""

from trainer.tasks.flow import Flow
from trainer.tasks.reconstruction import Reconstruction
from trainer.tasks.task import Asked, Task, Work

TASKS: dict[str, type[Task]] = {"reconstruction": Reconstruction, "flow": Flow}
"""Tasks by name."""

__all__ = ["TASKS", "Asked", "Flow", "Reconstruction", "Task", "Work"]
