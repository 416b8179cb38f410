"""Views of panoramas: one self-contained HTML page, a video, a log for Rerun.

page          PageWriter: frames in, one HTML file out; its HTML, CSS, JavaScript and shaders lie in web/.
saved_frames  frames of panoramas saved as PNG.
outputs       files of `translate` about all of its scans together.
"""
