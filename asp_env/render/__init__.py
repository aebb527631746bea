"""Pictures for people. What a network sees is drawn by `asp_env.views`."""
