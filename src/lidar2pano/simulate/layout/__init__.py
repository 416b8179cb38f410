"""Where everything is: roads, ground, buildings, kerbside objects, traffic and the recording car."""
