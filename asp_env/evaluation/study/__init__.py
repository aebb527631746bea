"""The closed-loop study: methods, traffic, latency and data, in cells that are driven once.

- `settings`: what a study drives, from a TOML file or options;
- `conditions`: the conditions and methods of a study, with everything loaded;
- `identity`: hashes of what a result depends on;
- `cells`: results of work units in a content-addressed folder;
- `driving`: the cells that are missing are driven, in one or many processes;
- `study`: the command `asp-env study`;
- `compare`: the command `asp-env compare`.
"""
