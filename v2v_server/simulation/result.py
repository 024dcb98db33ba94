"""The former place of :class:`v2v_server.simulation.Voxels`, documented in release 0.2.0."""

from v2v_server.simulation.kernels import Voxels as Voxels
