"""The former place of :class:`v2v_client.Patience`, documented in release 0.2.0."""

from v2v_client.options import Patience as Patience
