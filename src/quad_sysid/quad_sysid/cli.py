# PYTHON_ARGCOMPLETE_OK
"""`quad-sysid`: arguments and wiring; some commands are in the cli.py of their packages.

Slow imports (numba, scipy) are made where a command needs them, so that --help and completion are
fast.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')  # a process of one thread may fork: beside.py

from quad_sysid import comparison, exports
from quad_sysid.arguments import (
    BAD_ARGUMENTS,
    NOT_ANSWERED,
    Commands,
    Parser,
    candidates,
    command,
    effects_option,
    log_options,
    own_effects,
    positive,
    progress,
    quiet_and_json,
    run_command,
)
from quad_sysid.contract import AXES
from quad_sysid.errors import BadInputError, NotInformativeError
from quad_sysid.files import check_new, check_page, read_json, write_whole
from quad_sysid.fleets import cli as fleets
from quad_sysid.imports import cli as imports
from quad_sysid.record import Record
from quad_sysid.units import in_units_of


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    return run_command(_parser(), arguments)


def ros2() -> int:
    """`ros2 run quad_sysid identify …`: the command named like the executable."""
    return main([Path(sys.argv[0]).name, *sys.argv[1:]])


def _parser() -> Parser:
    parser = Parser.program(
        'quad-sysid', 'quad_sysid',
        'Identify a quadrotor from bags and find what the model lacks.',
        'quad-sysid identify my_flight --axis roll --out result',
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    _inspect_parser(commands)
    _look_parser(commands)
    _identify_parser(commands)
    _evaluate_parser(commands)
    imports.add(commands)
    _design_parser(commands)
    exports.add(commands)
    comparison.add(commands)
    fleets.add(commands)
    _app_parser(commands)
    command(commands, 'compile', _compile,
            'Compile all that numba compiles, so that no first use has to wait (images, CI).',
            'quad-sysid compile')
    return parser


def _inspect_parser(commands: Commands) -> None:
    parser = command(
        commands, 'inspect', _inspect,
        'Show on one page what a bag or log holds and what it can be used for, without a fit.',
        'quad-sysid inspect flight/', reads='bag', writes='file',
    )
    parser.add_argument('bag', metavar='BAG', help='rosbag2 directory, .mcap file, a log of PX4, '
                        'ArduPilot, Betaflight or INAV, or a table')
    log_options(parser)
    parser.add_argument('--out', metavar='HTML', type=Path,
                        help='write a page too, with the motors drawn in their places')
    quiet_and_json(parser, 'one JSON object')


def _look_parser(commands: Commands) -> None:
    parser = command(
        commands, 'look', _look,
        'Measure what any log or bag shows without a model: step response, spectra, loop, '
        'delays, motors, tracking. Seconds, no identification.',
        'quad-sysid look LOG00001.BFL --out look.html', reads='file', writes='file',
    )
    parser.add_argument('file', metavar='FILE', nargs='+', help='a log of PX4, ArduPilot, '
                        'Betaflight or INAV, a table, or a bag; several are laid over one another')
    parser.add_argument('--out', metavar='HTML', help='the page to write (default: FILE_look.html '
                        'in this folder; an older one of look is replaced)')
    log_options(parser)
    parser.add_argument('--no-page', action='store_true', help='write no page')
    quiet_and_json(parser, 'one JSON object (of several files a list)')


def _identify_parser(commands: Commands) -> None:
    parser = command(
        commands, 'identify', _identify,
        'Fit models to bags, validate them, and say what they lack. Prints the models, the '
        'verdict, the effects that were added and the errors before and after; writes '
        'report.html, report.json and model.json, with gains where quad_tuning is installed.',
        'quad-sysid identify flight/ --axis roll --out report/', reads='bags',
    )
    parser.add_argument('bags', nargs='+', metavar='BAG', help='rosbag2 directory or .mcap file')
    parser.add_argument('--axis', metavar='AXES', help='roll, pitch, yaw, surge, sway or climb, '
                        'several with commas between; all: roll, pitch and yaw; every: all six '
                        '(default: the axes that the bag says were excited)')
    parser.add_argument('--train', metavar='A:B', help='seconds from the first /imu/data stamp')
    parser.add_argument('--validate', metavar='A:B', help='seconds from the first stamp')
    parser.add_argument('--out', metavar='DIR', type=Path, help='folder of the report, which '
                        'replaces an earlier one there (default: <bag>_identified here, numbered '
                        'where that exists)')
    parser.add_argument('--inertia', metavar='IX,IY,IZ',
                        help='kg m²; the report then gives torques in N m as well')
    parser.add_argument('--mass', type=float, metavar='KG', help='mass of the aircraft; thrust, '
                        'drag and inertia then follow')
    parser.add_argument('--thrust', type=float, metavar='N',
                        help='full thrust of all motors, where the mass is not known')
    parser.add_argument('--no-effects', action='store_true', help='fit the models only')
    effects_option(parser)
    quiet_and_json(parser, 'report.json')


def _evaluate_parser(commands: Commands) -> None:
    parser = command(commands, 'evaluate', _evaluate,
                     'Error figures of a stored model on a bag it has never seen.',
                     'quad-sysid evaluate report/model.json second_flight/ --json', reads='bag')
    parser.add_argument('model', metavar='MODEL.json',
                        help='written by quad-sysid identify, or its folder')
    parser.add_argument('bag', metavar='BAG', help='rosbag2 directory or .mcap file')
    parser.add_argument('--axis', metavar='AXES', help='roll, pitch, yaw, surge, sway or climb, '
                        'several with commas between (default: every axis of the model)')
    parser.add_argument('--validate', metavar='A:B',
                        help='seconds; default: all but the idle segments')
    effects_option(parser)
    quiet_and_json(parser, 'one JSON object')


def _design_parser(commands: Commands) -> None:
    parser = command(
        commands, 'design-excitation', _design,
        'Design excitation signals for a band, or the flight that separates two effects.',
        'quad-sysid design-excitation --band 0.1:20 --out schedule.yaml',
        writes='file',
    )
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument('--band', metavar='LOW:HIGH', help='rad/s')
    what.add_argument('--separate', metavar='EFFECT', nargs='*',
                      help='two effects (or one and "nothing"); none: the effect of --model and '
                      'its nearest rival')
    parser.add_argument('--model', metavar='MODEL.json', help='with --separate: the aircraft '
                        "(default: the paper's)")
    parser.add_argument('--seconds', type=float, metavar='S',
                        help='length of the training (default: with --separate 60; with --band '
                        'one period by eq. (9), which ends somewhat above LOW)')
    parser.add_argument('--rate', type=float, metavar='HZ',
                        help='with --band: sample rate (default 250)')
    parser.add_argument('--axis', choices=AXES,
                        help='one, since a schedule excites one (default: roll, or '
                        "the model's axis with the nearest rivals)")
    parser.add_argument('--amplitude-deg', type=float, metavar='DEG',
                        help='with --band: amplitude of the angle, degrees (default 12)')
    parser.add_argument('--out', metavar='FILE', type=Path,
                        help='write a schedule as YAML to this new file')
    effects_option(parser)
    parser.add_argument('--quiet', action='store_true', help='print nothing but errors')


def _app_parser(commands: Commands) -> None:
    parser = command(
        commands, 'app', _app,
        'Look at logs, identify and compare in a browser, on this machine only.',
        'quad-sysid app my_flights',
    )
    parser.add_argument('folder', metavar='FOLDER', nargs='?', type=Path, default=Path(),
                        help='the logs and bags that are shown; dropped files and results go '
                        'there (default: this folder)')
    parser.add_argument('--port', type=int, default=0,
                        help='port on 127.0.0.1 (default: a free one)')
    parser.add_argument('--most-mb', metavar='MB', type=float, default=200.0,
                        help='largest file that may be dropped (default %(default)g)')
    parser.add_argument('--no-browser', action='store_true', help='print the address only')


def _inspect(options: argparse.Namespace) -> int:
    from quad_sysid.inspection.content import content
    from quad_sysid.inspection.page import MARK, lines, page
    from quad_sysid.report.words import by_reason

    report = content(options.bag, options.log, options.messages)
    if options.out is not None:
        check_page(options.out, MARK, 'inspect')
        write_whole(options.out, page(report))
    if options.json:
        print(json.dumps({'schema': 'quad_sysid/inspection/1', **asdict(report)}, indent=1))
    elif not options.quiet:
        print('\n'.join(lines(report)))
    if report.unusable:
        print(f'quad-sysid: {report.unusable}', file=sys.stderr)
        return BAD_ARGUMENTS
    answers = [use.possible for axis in report.axes for use in axis.uses]
    if not any(answers):
        why = by_reason({axis.axis: '; '.join(use.because for use in axis.uses)
                         for axis in report.axes})
        print(f'quad-sysid: {options.bag}: {why}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def _look(options: argparse.Namespace) -> int:
    from quad_sysid.logview import several
    from quad_sysid.logview.read import look

    if len(options.file) > several.MOST:
        raise BadInputError('look', f'takes {several.MOST} files at most', len(options.file))
    show = progress(quiet=options.quiet)
    looks = []
    for file in options.file:
        show(f'reading {file}')
        looks.append(look(file, log=options.log, messages=options.messages))
    only = looks[0] if len(looks) == 1 else None
    out = None
    if not options.no_page:
        from quad_sysid.logview.page import MARK, page

        first = Path(options.file[0]).resolve()
        stem = 'several' if not only else first.name if first.is_dir() else first.stem
        out = Path(options.out or f'{stem or "log"}_look.html')
        check_page(out, MARK, 'look')
        show('drawing')
        write_whole(out, page(only) if only else several.page(looks))
    show('')
    if options.json:
        trees = [look.tree() for look in looks]
        print(json.dumps(trees[0] if only else trees, indent=1))
    elif not options.quiet:
        print(only or '\n'.join(several.figures(looks).text()))
        if out is not None:
            print(f'\npictures in {out}')
    return 0


def _identify(options: argparse.Namespace) -> int:
    from quad_sysid import session
    from quad_sysid.report import text

    keywords = session.keywords(
        () if options.axis is None else options.axis.split(','), options.train or '',
        options.validate or '', options.inertia or '',
    ) | {'effects': candidates(options)} | {
        name: positive(f'--{name}', value) for name in ('mass', 'thrust')
        if (value := getattr(options, name)) is not None}
    show = progress(quiet=options.quiet)
    outcome = session.run(options.bags, options.out, keywords, show)
    if options.json:
        print(json.dumps(outcome.report, indent=1))
    elif not options.quiet:
        print('\n'.join(text.lines(outcome.report)))
        print(f'\nreport in {outcome.folder}/report.html')
    if not outcome.answered:
        print(f'quad-sysid: {options.bags[0]}: {outcome.reasons}', file=sys.stderr)
        return NOT_ANSWERED
    return 0


def _evaluate(options: argparse.Namespace) -> int:
    from quad_sysid.bags import clip_span, parse_span, read_bag
    from quad_sysid.pipeline.evaluate import evaluate
    from quad_sysid.report import document, tables, text, words
    from quad_sysid.report.model_file import load_blackbox, load_models, names_model, pick

    if names_model(options.bag):
        swapped = f'the model comes first: quad-sysid evaluate {options.bag} {options.model}'
        raise BadInputError(options.bag, 'is a model, where a bag is wanted',
                            remedy='give a bag' if names_model(options.model) else swapped)
    models = pick(load_models(options.model, own_effects(options.effects)), options.axis,
                  options.model)
    polynomials = load_blackbox(options.model)
    request = parse_span(options.validate, '--validate') if options.validate else None
    record = read_bag(options.bag)
    span, warnings = clip_span(request, record, '--validate')
    is_training = span is None and _trained(options, record)
    own = (f'{options.bag}: the model was identified from this flight, so that its error here is '
           'no test; give another one, or --validate with what was held out')
    doubts = (line for line in record.warnings if not line.startswith('import'))
    for line in (*doubts, *warnings, *([own] if is_training else [])):
        print(f'quad-sysid: {line}', file=sys.stderr)
    spans = () if span is None else (span,)
    evaluations, refused = [], {}
    for axis in models:
        try:
            evaluations.append(evaluate(models[axis], record, spans, polynomials.get(axis)))
        except NotInformativeError as error:  # noqa: PERF203  an axis each
            refused[axis] = str(error)
    if refused:
        print(f'quad-sysid: {words.by_reason(refused)}', file=sys.stderr)
    if not evaluations:
        return NOT_ANSWERED
    axes = {
        e.axis: {'error': {'metric': in_units_of(models[e.axis].units, document.METRIC),
                           'data': 'training' if is_training else 'unseen', 'unit': e.unit,
                           'before': e.before, 'after': e.after,
                           'reference': e.after if e.reference is None else e.reference,
                           'one_step_before': e.one_step_before,
                           'one_step_after': e.one_step_after, 'blackbox': e.blackbox,
                           'hold_last_value': e.hold, 'windows': e.windows, 'own': e.own,
                           'horizons': document.horizons_tree(e.horizons, e.blackbox_horizons)},
                 'explanation': [{'effects': names, 'explains_pct': percent, 'error': error,
                                  'answer': answer}
                                 for names, percent, error, answer in e.rungs],
                 'outside': [vars(excess) for excess in e.outside]}
        for e in evaluations
    }
    if options.json:
        unanswered = {'not_answered': refused} if refused else {}
        print(json.dumps(document.plain(  # without numbers that are not finite
            {'schema': 'quad_sysid/evaluation/1', 'axes': axes, **unanswered})))
        return 0
    for e in () if options.quiet else evaluations:
        tree = {**axes[e.axis], 'effects': models[e.axis].effects}
        beyond = [line for excess in e.outside for line in tables.wrapped(
            in_units_of(models[e.axis].units, str(excess)))]
        print('\n'.join([e.axis, *tables.wrapped(words.on_this_flight(tree)), *text.spaced([
            tables.errors(tree).text((0, 1, 3)), tables.explanation(tree).text(),
            text.growth(tree), beyond])]))
    return 0


def _trained(options: argparse.Namespace, record: Record) -> bool:
    """Whether the report beside the model trained on a bag of this name and these segments."""
    from quad_sysid.bags import split_segments
    from quad_sysid.report import document
    from quad_sysid.report.model_file import located

    try:
        tree = read_json(located(options.model).with_name('report.json'))
    except BadInputError:
        return False
    if not isinstance(tree, dict) or tree.get('schema') != document.SCHEMA:
        return False
    train_segments = {(axis, round(segment['start_s'], 3), round(segment['end_s'], 3))
                      for axis, of_axis in tree['axes'].items() for segment in of_axis['segments']
                      if segment['role'] == 'train'}
    own = {(s.axis, round(s.start_s, 3), round(s.end_s, 3))
           for s in split_segments(record).segments
           if s.role == 'train' and s.axis in tree['axes']}
    return bool(own) and own <= train_segments and Path(options.bag).name in {
        Path(name).name for name in tree['bags']}


def _app(options: argparse.Namespace) -> int:
    try:
        import fcntl

        import uvicorn

        from quad_sysid.app.server import App
    except ImportError as error:
        raise BadInputError('app', f'needs the package {error.name}',
                            remedy='pip install starlette uvicorn') from error
    if not options.folder.is_dir():
        raise BadInputError(str(options.folder), 'is no folder', remedy='name one with logs')
    if not 0 <= options.port <= 65535:
        raise BadInputError('--port', 'must be 0 to 65535', options.port)
    most_mb = positive('--most-mb', options.most_mb)
    try:  # until this process ends
        fcntl.flock(os.open(options.folder, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:  # which would show the jobs of the other one as stopped
        raise BadInputError(str(options.folder), 'has an app that runs',
                            remedy='open the address that it printed, or end it') from error
    except OSError:
        pass  # a file system without locks
    app = App(options.folder, most_mb)
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        line.bind(('127.0.0.1', options.port))
        line.listen()  # from here on a browser waits for the server
    except OSError as error:
        raise BadInputError('--port', 'is taken', options.port, 'choose another') from error
    address = f'http://127.0.0.1:{line.getsockname()[1]}/?token={app.token}'
    print(f'{address}\nCtrl-C ends it.', flush=True)
    if not options.no_browser:
        import webbrowser

        webbrowser.open(address)
    server = uvicorn.Server(uvicorn.Config(app.starlette(), log_level='warning',
                                           server_header=False, timeout_graceful_shutdown=2))
    server.run(sockets=[line])
    return 0


def _compile(_: argparse.Namespace) -> int:
    from quad_sysid.compiled import compile_all

    print('\n'.join(f'compiled in {folder}' for folder in compile_all()))
    return 0


def _design(options: argparse.Namespace) -> int:
    from quad_sysid.report.tables import wrapped
    from quad_sysid.signals.design import design_excitation, parse_band

    if options.out:
        check_new(options.out)
    if options.separate is not None:
        text, content = _separation(options)
    else:
        rate = 250.0 if options.rate is None else options.rate
        size = 12.0 if options.amplitude_deg is None else options.amplitude_deg
        design = design_excitation(*parse_band(options.band), rate, options.seconds)
        text = '\n'.join(part for line in design.text().splitlines()
                         for part in wrapped(line, '  ', ''))
        content = design.to_schedule_yaml(options.axis or 'roll', size)
    if options.out:
        write_whole(options.out, content)
        text += f'\nschedule in {options.out}'
    if not options.quiet:
        print(text)
    return 0


def _separation(options: argparse.Namespace) -> tuple[str, str]:
    """Table and schedule of the flights that separate two effects."""
    from quad_sysid.report.model_file import load_models, pick
    from quad_sysid.result import separate
    from quad_sysid.separation import words
    from quad_sysid.separation.design import nearest

    for name in ('rate', 'amplitude_deg'):
        if getattr(options, name) is not None:
            raise BadInputError(f"--{name.replace('_', '-')}", 'belongs to --band: --separate '
                                'compares amplitudes up to 20 degrees', getattr(options, name),
                                'leave it out, and choose among the flights in the table')
    names, own = options.separate, own_effects(options.effects)
    seconds = 60.0 if options.seconds is None else options.seconds
    if len(names) not in (0, 2):
        raise BadInputError('--separate', 'needs two effects or none', ' '.join(names),
                            'for example --separate coulomb_friction quadratic_drag')
    if options.model is None and not names:
        raise BadInputError('--separate', 'without effects needs --model',
                            remedy='name two effects, or give --model result/model.json')
    show = progress(quiet=options.quiet)
    aircraft = options.axis or AXES[0] if options.model is None else nearest(
        pick(load_models(options.model, own), options.axis, options.model))
    result = separate(aircraft, names, seconds, effects=own, source=options.model, progress=show)
    show('')
    return words.text(result), words.schedule(result)


if __name__ == '__main__':
    sys.exit(main())
