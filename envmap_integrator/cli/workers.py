"""``--workers`` and ``--cluster``: pictures by other processes, with Dask."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

if TYPE_CHECKING:
    from distributed import Client

    from envmap_integrator.distributed.job import Job


def renderer(args: argparse.Namespace, stack: ExitStack) -> Callable[..., mi.TensorXf]:
    """What renders as ``integrator.render`` does, by workers that are there until ``stack`` ends.

    Raises ``ValueError`` if there are none, or if one of them can't give the same picture.
    """
    client, job = _found(args, stack)
    from envmap_integrator.distributed.job import View
    from envmap_integrator.distributed.render import check_workers, render_job

    check_workers(client, job)

    def render(scene, sensor, seed, spp):
        ((_, picture),) = render_job(client, job, scene, [View(args.sensor)], spp, seed)
        return picture

    return render


def pass_renderer(args: argparse.Namespace, stack: ExitStack, scene: mi.Scene) -> Callable:
    """``elsewhere`` of ``integrator.progressive``: as ``renderer``."""
    client, job = _found(args, stack)
    from envmap_integrator.distributed.progressive import by_workers

    return by_workers(client, job, scene, args.sensor)


def _found(args: argparse.Namespace, stack: ExitStack) -> tuple[Client, Job]:
    if not importlib.util.find_spec("distributed"):
        raise ImportError("Dask is missing: pip install distributed")
    # It takes a while, and few need it.
    from envmap_integrator.distributed import cluster
    from envmap_integrator.distributed.job import Job

    if args.cluster is not None:
        client = stack.enter_context(cluster.connected(args.cluster, args.tls))
    elif args.workers < 1:
        raise ValueError(f"--workers must be at least 1, got {args.workers}")
    else:
        client = stack.enter_context(cluster.local(args.workers, dr.thread_count()))
    job = Job.of(
        args.scene,
        parameters=dict(args.define),
        integrator=args.integrator,
        settings=dict(args.set),
        denoise=args.denoise,
    )
    return client, job
