"""The flight controller from this side: wire, link, gains, log, sensors; the virtual STM32."""
