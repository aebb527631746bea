"""What `asp-env bench` measures: copying, drawing, stepping, environments, predictors."""
