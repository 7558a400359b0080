"""The closed loop: the cascade C1/C2 around an identified plant, its margins and step figures."""
