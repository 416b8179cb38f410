"""Drives: scans in time, of files, folders and recordings.

folders       files of a folder, their times, names of their outputs;  following: a growing folder.
reading       scans as they are read one after the other, all of a stream alike.
drive_motion  motion of the sensor: recorded, else estimated; scans without skew.
"""
