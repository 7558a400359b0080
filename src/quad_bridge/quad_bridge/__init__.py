"""The link to the flight controller: wire, gains, log, sensors, the virtual STM32."""
