"""The command `jaxsubdiv-fit`: its options, and what they ask for."""
