"""The former place of :class:`v2v_client.Patience`."""
