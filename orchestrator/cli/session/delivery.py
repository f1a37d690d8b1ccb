"""The delivery of a run: its merged model as files that others open, next to the PLY."""

import time
from typing import Any

from panolog.export.georeference import Georeference, georeference_of
from panolog.export.site.write import MOST_IN_ONE, write_page, write_site
from panolog.orchestrator.engine.driver.job import Job
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.info import installed_versions
from panolog.orchestrator.runs.records import Delivered, Noticed, Record
from panolog.orchestrator.watch.views.site.build import Wanted, site_of_run, write_file
from panolog.scene.errors import InputError
from panolog.scene.ply import ply_offset, read_sky, write_ply
from panolog.workers.tasks import DELIVER


def deliver(job: Job) -> list[Record]:
    """Writes sky.ply, georef.json, web/ and view.html of a run.

    What is wrong with the model or its place is a notice.

    Raises OSError if the disk takes no file.
    """
    started, folder, scene = time.monotonic(), job.folder, job.scene
    try:
        place = georeference_of(scene)
        _write(folder, place, provenance(scene.fingerprint, job.config, installed_versions()))
    except InputError as error:
        seconds = time.monotonic() - started
        return [Noticed(DELIVER, f"no files for viewers: {error}"), Delivered("", 0, seconds)]
    files = [folder.sky, folder.georeference, folder.page]
    files += filter(lambda path: path.is_file(), folder.web.rglob("*"))
    size = sum(path.stat().st_size for path in files)
    return [Delivered(folder.relative(folder.web), size, time.monotonic() - started)]


def provenance(fingerprint: str, config: RunConfig, versions: dict[str, str]) -> dict[str, Any]:
    """What a run's model was made of."""
    return {"scene": fingerprint, "versions": versions, "settings": config.model_dump(mode="json")}


def _write(folder: RunFolder, place: Georeference, made_of: dict[str, Any]) -> None:
    model = folder.point_cloud
    write_ply(folder.sky, read_sky(model), offset=ply_offset(model))
    write_json(folder.georeference, place.as_json(made_of))
    shown = site_of_run(folder, Wanted(place=place))
    write_site(folder.web, shown.write_model, shown.page)
    if folder.sog.is_file():
        write_page(folder.page, folder.sog.read_bytes(), shown.page)
    else:
        write_file(site_of_run(folder, Wanted(most=MOST_IN_ONE, place=place)), folder.page)
