"""The command line: thin; options, rendering, exit codes."""
