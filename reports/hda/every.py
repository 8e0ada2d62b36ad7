"""Every section about landings, in the order of the page."""

from marsyard.reports.hda.faults import landing_faults_section
from marsyard.reports.hda.hazards import hazards_section
from marsyard.reports.hda.limits import limits_section
from marsyard.reports.hda.map_errors import map_section
from marsyard.reports.hda.run_times import run_times_section
from marsyard.reports.hda.threshold import threshold_section
from marsyard.reports.hda.touchdown import touchdown_section
from marsyard.reports.section import SectionMaker

#: Those alone appear whose columns the rows hold and whose conditions vary.
HDA_SECTIONS: tuple[SectionMaker, ...] = (
    threshold_section,
    landing_faults_section,
    limits_section,
    map_section,
    touchdown_section,
    hazards_section,
    run_times_section,
)
