"""stub"""

from compare.options import Options


def run(options, folder):
    return []
