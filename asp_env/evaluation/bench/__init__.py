"""`asp-env bench`: the speed of rendering, stepping, environments and predictors."""
