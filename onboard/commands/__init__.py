"""Commands of `swathd` beside recording; each module has HELP, add_arguments(parser) and run(options) -> exit code."""
