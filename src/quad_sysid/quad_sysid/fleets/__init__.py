"""`quad-sysid fleet`: many bags, a row each; what the rows say of aircraft and months.

`bag.py` makes the row of one bag, in a process of its own, wherever that runs: `engine.py` has it
made for all that wait, by threads of this machine or by Dask. The folder of results (`place.py`,
here or on an object store) is the only state. `page.py` asks `drift.py` (numbers only) what the
rows say, and writes it down; `cli.py` makes tables of them.
"""
