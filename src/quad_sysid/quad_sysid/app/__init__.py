"""The page on this machine (`quad-sysid app`): files, looks, identifications as jobs, results.

It is a server of pages and a queue of the commands' own processes; no mathematics runs in it.
"""
