"""Everything that is sent is encoded, signed and written in one place, under one lock."""

import ast
from pathlib import Path

NODE = Path(__file__).parents[2] / 'src/quad_bridge/quad_bridge/nodes/serial_bridge.py'


def calls(tree, *names):
    return [
        node for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
        and node.func.attr in names
    ]  # fmt: skip


def test_frames_cannot_swap_between_encoding_and_writing():
    tree = ast.parse(NODE.read_text(encoding='utf-8'))
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    writing = {one.name for one in functions if calls(one, 'to_send', 'write')}
    assert writing == {'_flush'}
    locked = [
        node for node in ast.walk(tree)
        if isinstance(node, ast.With) and '_lock' in ast.unparse(node.items[0])
    ]  # fmt: skip
    inside = sum(len(calls(block, '_flush')) for block in locked)
    assert inside == len(calls(tree, '_flush')) > 3
    # what is queued goes out before the lock is let go
    for block in locked:
        if calls(block, 'send', 'tick', 'receive'):
            assert calls(block, '_flush')
