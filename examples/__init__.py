"""Short programs to start from; each runs on the data that the package ships."""
