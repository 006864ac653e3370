"""`swath completion`: a script that lets a shell complete commands, options and their values."""

import argparse
import shlex
from dataclasses import dataclass

HELP = "print a script for shell completion: bash, zsh or fish"
SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.description = (
        'Put eval "$(swath completion bash)" into ~/.bashrc, eval "$(swath completion zsh)" into ~/.zshrc, or write '
        "swath completion fish to ~/.config/fish/completions/swath.fish."
    )
    parser.add_argument("shell", choices=SHELLS, help="which shell")


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    makers = {"bash": bash, "zsh": zsh, "fish": fish}
    print(makers[arguments.shell](words()), end="")
    return 0


@dataclass(frozen=True, slots=True)
class Word:
    """An option of a command.

    Attributes
    ----------
    names : tuple of str
    about : str
        First clause of its help.
    takes_value : bool
    choices : tuple of str
        The values that it takes; empty for any, which is completed as a file.
    """

    names: tuple[str, ...]
    about: str
    takes_value: bool
    choices: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Words:
    """A command: what it is for, its options, and the choices of what stands without an option."""

    about: str
    options: tuple[Word, ...]
    choices: tuple[str, ...]


def words() -> dict[str, Words]:
    """All commands that can be loaded here, from the parsers that they themselves use."""
    from groundproc.cli import commands

    found = {}
    for name, point in commands().items():
        try:
            module = point.load()
            parser = argparse.ArgumentParser(prog=f"swath {name}")
            module.add_arguments(parser)
        except ImportError:  # a command whose libraries are not installed
            continue
        options: list[Word] = []
        choices: list[str] = []
        for action in parser._actions:
            values = tuple(str(value) for value in action.choices or ())
            if not action.option_strings:
                choices += values
                continue
            about = (action.help or "").partition(";")[0].replace("%%", "%")
            options.append(Word(tuple(action.option_strings), about, action.nargs != 0, values))
        found[name] = Words(module.HELP, tuple(options), tuple(choices))
    return found


def bash(commands: dict[str, Words]) -> str:
    """A function and a line that registers it; zsh takes it too."""
    cases = []
    for name, command in commands.items():
        values = "".join(
            f"      {'|'.join(option.names)}) choices={shlex.quote(' '.join(option.choices))} ;;\n"
            for option in command.options
            if option.choices
        )
        free = "|".join(name for option in command.options if option.takes_value for name in option.names)
        flags = " ".join(name for option in command.options for name in option.names)
        inner = f'      case "$before" in\n{values}      esac\n' if values else ""
        taking = f'      case "$before" in {free}) taken=1 ;; esac\n' if free else ""
        cases.append(
            f"    {name})\n{inner}{taking}      flags={shlex.quote(flags)}; free={shlex.quote(' '.join(command.choices))} ;;\n"
        )
    return (
        "_swath() {\n"
        '  local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}"\n'
        '  local flags="" free="" choices="" taken=""\n'
        "  COMPREPLY=()\n"
        '  if [ "$COMP_CWORD" -eq 1 ]; then\n'
        f'    COMPREPLY=($(compgen -W {shlex.quote(" ".join(commands) + " --help --version")} -- "$word")); return\n'
        "  fi\n"
        '  case "${COMP_WORDS[1]}" in\n' + "".join(cases) + "  esac\n"
        '  if [ -n "$choices" ]; then COMPREPLY=($(compgen -W "$choices" -- "$word"))\n'
        '  elif [ -z "$taken" ] && [ "${word#-}" != "$word" ]; then COMPREPLY=($(compgen -W "$flags" -- "$word"))\n'
        '  elif [ -z "$taken" ] && [ -n "$free" ]; then COMPREPLY=($(compgen -W "$free" -- "$word"))\n'
        '  else compopt -o filenames 2>/dev/null; COMPREPLY=($(compgen -f -- "$word")); fi\n'
        "}\n"
        "complete -F _swath swath\n"
    )


def zsh(commands: dict[str, Words]) -> str:
    """A completion of zsh's own kind, with what each command and option is for."""
    listed = " ".join(shlex.quote(f"{name}:{command.about}") for name, command in commands.items())
    cases = []
    for name, command in commands.items():
        specs = [_zsh_option(option) for option in command.options]
        free = f"({' '.join(command.choices)})" if command.choices else "_files"
        rest = shlex.quote("*:file:" + free)
        cases.append(f"    {name}) _arguments {' '.join([*specs, rest])} ;;\n")
    return (
        "#compdef swath\n"
        "_swath() {\n"
        "  local -a commands\n"
        f"  commands=({listed})\n"
        "  if (( CURRENT == 2 )); then _describe command commands; return; fi\n"
        "  local name=$words[2]\n"
        "  shift words; (( CURRENT-- ))\n"
        "  case $name in\n" + "".join(cases) + "  esac\n"
        "}\n"
        "(( $+functions[compdef] )) || { autoload -Uz compinit && compinit; }\n"
        "compdef _swath swath\n"
    )


def _zsh_option(option: Word) -> str:
    about = option.about.replace("[", "(").replace("]", ")").replace(":", r"\:")
    value = ""
    if option.takes_value:
        value = f":value:({' '.join(option.choices)})" if option.choices else ":value:_files"
    return " ".join(shlex.quote(f"{name}[{about}]{value}") for name in option.names)


def fish(commands: dict[str, Words]) -> str:
    """One line for each command and option."""
    lines = ["complete -c swath -f"]
    for name, command in commands.items():
        lines.append(f"complete -c swath -n __fish_use_subcommand -a {name} -d {_fish_text(command.about)}")
        here = f"-n '__fish_seen_subcommand_from {name}'"
        if command.choices:
            lines.append(f"complete -c swath {here} -a {_fish_text(' '.join(command.choices))}")
        else:
            lines.append(f"complete -c swath {here} -F")
        for option in command.options:
            names = " ".join(f"-l {n[2:]}" if n.startswith("--") else f"-s {n[1:]}" for n in option.names)
            value = ""
            if option.takes_value:
                value = f" -x -a {_fish_text(' '.join(option.choices))}" if option.choices else " -r -F"
            lines.append(f"complete -c swath {here} {names}{value} -d {_fish_text(option.about)}")
    return "\n".join(lines) + "\n"


def _fish_text(text: str) -> str:
    """Quoted for fish, where a backslash and a quote are escaped within quotes."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
