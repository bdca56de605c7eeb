"""The grid tasks: their rules, the batched environment, and the scripted players that mark its ceilings."""
