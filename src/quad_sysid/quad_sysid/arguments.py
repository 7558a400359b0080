"""Arguments of every quad-sysid command: one-line errors, an example in each --help.

The commands are in cli.py and in the cli.py of their packages.
"""

from __future__ import annotations

import argparse
import io
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from traceback import walk_tb
from types import ModuleType
from typing import TYPE_CHECKING, Any, NoReturn

from quad_sysid.errors import BadInputError, QuadSysidError
from quad_sysid.files import check_place, check_there
from quad_sysid.interrupt import INTERRUPTED
from quad_sysid.one_line import one_line

if TYPE_CHECKING:
    from quad_sysid.model.effect import Effect

BAD_ARGUMENTS, NOT_ANSWERED = 2, 3
"""Exit status (contract, Commands)."""

STATUSES = 'exit status: 0 done, 2 bad input or arguments, 3 the data cannot answer'

OWN = 'own_effects'
"""Name of the module that the user's file of effects becomes."""

Commands = Any
"""Result of `add_subparsers`, whose type is private to argparse."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line; its subparsers too."""

    def __init__(self, *names: Any, **more: Any) -> None:
        super().__init__(*names, **more)
        self.set_defaults(parser=self)  # the innermost parser, whose --help helps

    @classmethod
    def program(cls, prog: str, package: str, description: str, example: str) -> Parser:
        """The parser of a whole program, with `--version` of its package."""
        parser = cls(
            prog=prog, description=description,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            epilog=f'example: {example}\n{STATUSES}\n{prog} COMMAND --help says more',
        )
        parser.add_argument('--version', action=_Version, nargs=0, const=package,
                            help='print the version')
        return parser

    def error(self, message: str) -> NoReturn:
        """Exit with status 2 and one line on stderr."""
        if message.endswith('expected one argument'):
            option = message.split()[1].rstrip(':')
            message += f' (one that begins with - is written {option}=-…)'
        self.exit(BAD_ARGUMENTS, f'{self.prog}: {message}; see {self.prog} --help\n')


class _Version(argparse.Action):
    """Looks the version up only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import PackageNotFoundError, version

        try:
            words = version(str(self.const))
        except PackageNotFoundError:
            words = 'not installed, run from its sources'
        parser.exit(0, f'{parser.prog} {words}\n')


def command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], int], summary: str,
    example: str, *, reads: str = '', writes: str = '',
) -> argparse.ArgumentParser:
    """Add one command; its --help ends with `example`, a line to type.

    `reads`: the argument with its input paths; `writes`: `file` or `folder`, what its `out` is.
    Both are checked before it runs.
    """
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=summary,
                                                          epilog=f'example: {example}')
    parser.set_defaults(run=run, reads=reads, writes=writes)
    return parser


def quiet_and_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Add `--json`, which prints `what` instead of text, and `--quiet`."""
    parser.add_argument('--json', action='store_true', help=f'print {what} instead of text')
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')


def log_options(parser: argparse.ArgumentParser) -> None:
    """Add `--log` and `--messages`, of logs that need them."""
    parser.add_argument('--log', metavar='N', type=int, default=1,
                        help='number of the log in a blackbox file of several (default 1)')
    parser.add_argument('--messages', metavar='FOLDER', type=Path,
                        help='checkout with the .msg files of a bag that holds no definitions, '
                        'such as px4_msgs')


def effects_option(parser: argparse.ArgumentParser) -> None:
    """Add `--effects`, which `own_effects` reads."""
    parser.add_argument('--effects', metavar='FILE.py', help='your own effects: the list EFFECTS '
                        'of this file, or one of each class of Effect in it')


def own_effects(path: str | None) -> tuple[Effect, ...]:
    """The effects in a Python file of the user's; none without a file.

    Raises BadInputError where the file cannot be run or holds none.
    """
    if path is None:
        return ()
    if not Path(path).exists():
        raise BadInputError(f'--effects {path}', 'there is no such file', remedy='check the path')
    import runpy

    from quad_sysid.effects import EFFECTS
    from quad_sysid.model.checked import checked
    from quad_sysid.model.effect import Effect

    sys.path.append(str(Path(path).resolve().parent))  # what lies beside it can be imported
    try:
        content = runpy.run_path(path, run_name=OWN)
        # as a module, so that processes side by side know its classes
        sys.modules[OWN] = ModuleType(OWN)
        vars(sys.modules[OWN]).update(content)
        own = content.get('EFFECTS') or [
            kind() for kind in content.values()
            if isinstance(kind, type) and issubclass(kind, Effect)
            and kind.__module__ == content['__name__']
        ]
    except Exception as error:
        raise BadInputError(f'--effects {path}', 'cannot be run',
                            f'{type(error).__name__}: {error}') from error
    if not own:
        raise BadInputError(f'--effects {path}', 'holds no effect', None,
                            'write a class of quad_sysid.Effect into it (docs/extend.md)')
    return tuple(e for e in checked(own, f'--effects {path}', EFFECTS) if e not in EFFECTS)


def candidates(options: argparse.Namespace) -> tuple[Effect, ...] | None:
    """Effects to try, by --effects and --no-effects; None for the default of `identify`."""
    if options.no_effects:
        return ()
    effects = own_effects(options.effects)
    if not effects:
        return None
    from quad_sysid.effects import EFFECTS

    return (*EFFECTS, *effects)


def positive(option: str, value: float) -> float:
    """The value if it is finite and above 0, else BadInputError naming the option."""
    if not 0.0 < value < float('inf'):
        raise BadInputError(option, 'must be a positive number', value)
    return value


def progress(*, quiet: bool = False) -> Callable[[str], None]:
    """A function that shows the stages of a long command on stderr; nothing if `quiet`.

    On a terminal it rewrites one line, and wipes it for an empty one. Otherwise it is silent: what
    goes wrong is said there in one line (contract).
    """
    if quiet or not sys.stderr.isatty():
        return lambda _: None

    def show(line: str) -> None:
        width = shutil.get_terminal_size().columns - 1
        print(f'\r\x1b[2K{line[:width]}', end='', file=sys.stderr, flush=True)  # noqa: T201

    return show


def run_command(parser: Parser, arguments: Sequence[str] | None) -> int:
    """Run the command; returns its exit status."""
    offer_completion(parser)
    for stream in (sys.stdout, sys.stderr):  # a file's name may hold any byte
        with suppress(OSError):  # a pipe that took the place of a file: it asks where that stood
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors='backslashreplace')
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        options.parser.error(f'unrecognized arguments: {" ".join(unknown)}')
    try:
        _check_paths(options)
        status: int = options.run(options)
        print(end='', flush=True)  # noqa: T201  a full disk is met here, not at the end of Python
    except QuadSysidError as error:
        _say(f'{parser.prog}: {error}')
        return error.exit_status
    except KeyboardInterrupt:
        _say(f'{parser.prog}: interrupted')
        return INTERRUPTED
    except Exception as error:
        if isinstance(error, OSError) and error.filename is None:
            # what is printed is refused, and Python would try it again at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            return 0
        if not (line := _fault_of_effect(error) or _fault_of_system(error)):
            raise
        _say(f'{parser.prog}: {line}')
        return BAD_ARGUMENTS
    return status


def _fault_of_system(error: Exception) -> str:
    """The line on a name that is too long, a folder for a file, a full disk; '' for others."""
    return '' if not isinstance(error, OSError) else one_line(
        str(error.filename or 'output'), 'is refused by the system', error.strerror,
        'check name, permissions and free space')


def _fault_of_effect(error: Exception) -> str:
    """The line on an error in the law of an effect that is not the project's; '' for others."""
    from quad_sysid.model.effect import Effect

    line = ''
    for frame, number in walk_tb(error.__traceback__):
        effect = next(iter(frame.f_locals.values()), None)
        if isinstance(effect, Effect) and not type(effect).__module__.startswith('quad_sysid.'):
            line = one_line(f'{frame.f_code.co_filename}:{number}',
                            f'{type(effect).__name__}.{frame.f_code.co_name} fails',
                            f'{type(error).__name__}: {error}', 'see docs/extend.md')
    return line


def _say(line: str) -> None:
    """A line on stderr, over one of progress."""
    sys.stderr.write(('\r\x1b[2K' if sys.stderr.isatty() else '') + f'{line}\n')


def _check_paths(options: argparse.Namespace) -> None:
    """Refuse paths that a command could not use, before it computes."""
    reads, writes = getattr(options, 'reads', ''), getattr(options, 'writes', '')
    paths = getattr(options, reads) if reads else []
    for path in paths if isinstance(paths, list) else [paths]:
        check_there(path)
    if writes and options.out is not None:
        check_place(Path(options.out), folder=writes == 'folder')


def offer_completion(parser: argparse.ArgumentParser) -> None:
    """Answer the shell's request for completions, if argcomplete is installed."""
    try:
        import argcomplete
    except ImportError:
        return
    argcomplete.autocomplete(parser)
