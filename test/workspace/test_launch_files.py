"""Launch files parse, start executables that exist, hand on arguments that are declared.

`launch` itself is not to be had without ROS 2: stand-ins note what they are called with.
"""

import re
import runpy
import sys
from pathlib import Path
from unittest import mock

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(ROOT.glob('src/*/launch/*.launch.py'))
MODULES = {
    'launch': ['LaunchContext', 'LaunchDescription'],
    'launch.actions': [
        'DeclareLaunchArgument', 'ExecuteProcess', 'IncludeLaunchDescription', 'OpaqueFunction',
        'SetEnvironmentVariable',
    ],
    'launch.conditions': ['IfCondition', 'UnlessCondition'],
    'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
    'launch.substitutions': ['LaunchConfiguration', 'TextSubstitution'],
    'launch_ros': [],
    'launch_ros.actions': ['Node'],
    'launch_ros.parameter_descriptions': ['ParameterValue'],
    'launch_ros.substitutions': ['ExecutableInPackage'],
    'ament_index_python.packages': ['get_package_share_directory'],
}


class Given(dict[str, str]):
    """What a launch was given: each argument something, unless another value is set here."""

    def __missing__(self, name: str) -> str:
        return f'<{name}>'

    def get(self, name: str, _default: object = None) -> str:  # type: ignore[override]
        return self[name]


def described(path: Path, **given: str) -> dict[str, list[mock._Call]]:
    """How often and with what the file calls each class of `launch`."""
    modules = {name: mock.Mock(spec=classes) for name, classes in MODULES.items()}
    share = modules['ament_index_python.packages'].get_package_share_directory
    share.side_effect = lambda package: str(ROOT / 'src' / package)
    modules['launch.substitutions'].LaunchConfiguration.side_effect = '<{}>'.format
    modules['launch_ros.parameter_descriptions'].ParameterValue.side_effect = parameter_value
    context = mock.Mock(launch_configurations=Given(given))
    deferred = modules['launch.actions'].OpaqueFunction
    deferred.side_effect = lambda function: function(context)
    with mock.patch.dict(sys.modules, modules):
        runpy.run_path(str(path))['generate_launch_description']()
    return {one: getattr(modules[name], one).call_args_list
            for name, classes in MODULES.items() for one in classes}


def parameter_value(value: object, value_type: type) -> object:
    """As Jazzy's: a substitution is converted to the type, plain text must be text already."""
    if isinstance(value, str) and value_type is not str:
        raise TypeError(f'{value!r} is not an instance of {value_type}')
    return value


def names(calls: list[mock._Call]) -> set[str]:
    return {call.args[0] for call in calls}


@pytest.mark.parametrize('log', ['true', 'inside'])
@pytest.mark.parametrize('path', FILES, ids=lambda p: p.name)
def test_what_it_uses_starts_and_includes_exists(
    path: Path, log: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path('<params_file>').touch()
    made = described(path, log=log)
    used, declared = set(re.findall(r'<(\w+)>', repr(made))), names(made['DeclareLaunchArgument'])
    assert used | ({'log'} & declared) == declared
    for argument in made['DeclareLaunchArgument']:
        assert argument.kwargs.get('description')
        if argument.args[0] == 'log':
            assert argument.kwargs['choices'] == ['true', 'inside', 'false']
    for node in made['Node']:
        package, executable = node.kwargs['package'], node.kwargs['executable']
        folder = ROOT / 'src' / package
        assert f"'{executable} = {package}." in (folder / 'setup.py').read_text(encoding='utf-8')
        config = (folder / 'config' / f'{executable}.yaml').read_text(encoding='utf-8')
        known = yaml.safe_load(config)[executable]['ros__parameters']
        source = ''.join(p.read_text(encoding='utf-8') for p in folder.rglob('*.py')
                         if p.name != 'launched.py')  # fmt: skip
        for given in (g for g in node.kwargs.get('parameters', []) if isinstance(g, dict)):
            plain = {name.removeprefix('bag_logger.') for name in given} - {'use_sim_time'}
            assert all(name in known or f"'{name}'" in source for name in plain)
    included = (described(Path(call.args[0])) for call in made['PythonLaunchDescriptionSource'])
    for include, other in zip(made['IncludeLaunchDescription'], included, strict=True):
        handed_on = dict(include.kwargs['launch_arguments'])
        assert set(handed_on) <= names(other['DeclareLaunchArgument'])


def test_a_file_of_parameters_that_is_not_there_starts_nothing() -> None:
    """Its bounds and guards would be missing."""
    bridge = ROOT / 'src/quad_bridge/launch/bridge.launch.py'
    with pytest.raises(ValueError, match='params_file: is no file: found nowhere'):
        described(bridge, params_file='nowhere.yaml')
