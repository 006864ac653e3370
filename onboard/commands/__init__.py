"""Commands of `swathd` other than recording; each has HELP, add_arguments(parser) and run(options) -> exit code."""
