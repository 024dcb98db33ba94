"""What networks are trained for. A task owns what it needs of the stream, its losses, its films and its metrics.

The training loop knows none of them by name: a network says its task (``VoxelNetwork.task``), and a task that is added
here is one more name for the networks to say.
"""

from trainer.tasks.flow import Flow
from trainer.tasks.reconstruction import Reconstruction
from trainer.tasks.task import Asked, Task, Work

TASKS: dict[str, type[Task]] = {"reconstruction": Reconstruction, "flow": Flow}
"""Tasks by the name that networks give them."""

__all__ = ["TASKS", "Asked", "Flow", "Reconstruction", "Task", "Work"]
