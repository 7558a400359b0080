"""The virtual STM32: physics, sensors, firmware, and its process behind a pseudo-terminal.

Data flow of one 4 ms cycle: sensors -> firmware -> motor commands -> physics. Imports only
`quad_bridge.wire`; the analysis never imports this package.
"""
