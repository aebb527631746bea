"""Training with Lightning: recipes, data, optimisation and the command `asp-env train`."""
