"""The sample package is installed by a test, not collected: one of its modules is broken."""

collect_ignore = ["asp_env_sample"]
