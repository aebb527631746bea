"""The Gymnasium environments: thin shells that hold state, seeds and spaces."""
