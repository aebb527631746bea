"""One suite per socket, over all plugs of its registry."""
