"""One suite per socket, over everything that its registry knows."""
