"""The plan of a town: roads, ground, buildings, kerbside objects, traffic and the recording car."""
