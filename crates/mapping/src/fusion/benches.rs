//! Pieces of one bench become the bench: which places hold a module, which hypotheses are confirmed, where it ends
//! (paper, 3.5).

use super::associate::Clusters;
use super::locate::LocatedCell;
use super::{Doubt, FusionParams, LocatedPiece, OpenDoubt, View};
use crate::layout::End;
use nalgebra::{Vector2, Vector3};
use rstar::RTree;
use rstar::primitives::GeomWithData;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// A module seen in one view.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Observation {
    pub view: usize,
    /// Index into the view's detections.
    pub detection: usize,
    /// Where this view alone puts it, metres.
    pub position_m: Vector3<f64>,
    /// What the cloud says at its ray (paper, 3.4), metres.
    pub cloud_m: Option<Vector3<f64>>,
}

/// A module of the fused structure.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FusedModule {
    /// Row from the north, 0 the first.
    pub row: i32,
    /// Column from the west, 0 the first; a missing module leaves its column free.
    pub col: i32,
    /// Sorted by view.
    pub observations: Vec<Observation>,
    /// Views that only inferred it.
    pub inferred_in: Vec<usize>,
}

/// A bench of the fused structure.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FusedBench {
    pub rows: i32,
    pub cols: i32,
    /// Sorted by row and column.
    pub modules: Vec<FusedModule>,
    /// Whether the images end before the bench does, in the west and in the east.
    pub open_ended: [bool; 2],
    /// 0 to 1.
    pub confidence: f64,
    /// Mean position of its modules, metres.
    pub middle_m: Vector3<f64>,
    /// Mean metres per column and per row in the horizontal plane.
    pub pitch_m: [Vector2<f64>; 2],
    /// The set of pieces that it is made of.
    pub(super) cluster: usize,
}

impl FusedBench {
    /// What it was seen by: view, and index into the view's detections.
    pub fn sightings(&self) -> impl Iterator<Item = (usize, usize)> {
        self.modules.iter().flat_map(|module| module.observations.iter().map(|seen| (seen.view, seen.detection)))
    }
}

/// What the views say of one place in a bench.
#[derive(Default)]
struct Votes {
    observations: Vec<Observation>,
    /// How many views detected it.
    observed: usize,
    /// Where one view alone detected it: the others that show the place, but have no module there nor expect one.
    unseen: Vec<usize>,
    /// Views whose piece has the place as a hypothesis.
    inferred: BTreeSet<usize>,
    /// Views that show the place past the end of their piece, empty.
    absent: BTreeSet<usize>,
}

/// Votes by row and column.
type Places = BTreeMap<(i32, i32), Votes>;

/// Assembles the benches from their pieces.
pub(super) fn assemble(
    views: &[View<'_>],
    pieces: &[LocatedPiece],
    clusters: &Clusters,
    params: &FusionParams,
    doubts: &mut Vec<OpenDoubt>,
) -> Vec<FusedBench> {
    (0..clusters.members.len())
        .filter_map(|cluster| assemble_bench(views, pieces, clusters, cluster, params, doubts))
        .collect()
}

fn assemble_bench(
    views: &[View<'_>],
    pieces: &[LocatedPiece],
    clusters: &Clusters,
    cluster: usize,
    params: &FusionParams,
    doubts: &mut Vec<OpenDoubt>,
) -> Option<FusedBench> {
    let (members, margin) = (&clusters.members[cluster], clusters.margins[cluster]);
    let votes = votes(views, pieces, clusters, members);
    // Modules are those that were visually confirmed; past the ends that most views see, one detection is no proof.
    let (mut accepted, outvoted): (Places, Places) = votes
        .into_iter()
        .filter(|(_, v)| !v.observations.is_empty())
        .partition(|(_, v)| v.observed > v.absent.len() / 2 && v.unseen.len() < params.many_views);
    let seen_by: BTreeSet<usize> = accepted.values().flat_map(|v| v.observations.iter().map(|o| o.view)).collect();
    // Two boxes that one view alone saw beside each other are no bench.
    if accepted.len() < 2 || (accepted.len() < 4 && seen_by.len() < 2) {
        return None;
    }
    let low_row = accepted.keys().map(|p| p.0).min()?;
    let low_col = accepted.keys().map(|p| p.1).min()?;
    let rows = accepted.keys().map(|p| p.0).max()? - low_row + 1;
    let cols = accepted.keys().map(|p| p.1).max()? - low_col + 1;
    let closed = |f: fn(&LocatedPiece) -> End, at: fn(&LocatedPiece) -> i32, offset: i32| {
        members
            .iter()
            .any(|&m| f(&pieces[m]) == End::Closed && clusters.placements[m].col + at(&pieces[m]) - low_col == offset)
    };
    let open_ended = [!closed(|p| p.west, |_| 0, 0), !closed(|p| p.east, |p| p.cols - 1, cols - 1)];
    let mut middle_m = Vector3::zeros();
    let mut modules = Vec::with_capacity(accepted.len());
    for ((row, col), entry) in &mut accepted {
        entry.observations.sort_by_key(|o| (o.view, o.detection));
        entry.observations.dedup_by_key(|o| o.view);
        middle_m +=
            entry.observations.iter().map(|o| o.position_m).sum::<Vector3<f64>>() / entry.observations.len() as f64;
        modules.push(FusedModule {
            row: row - low_row,
            col: col - low_col,
            observations: std::mem::take(&mut entry.observations),
            inferred_in: entry.inferred.iter().copied().collect(),
        });
    }
    middle_m /= modules.len() as f64;
    let mean_pitch = |axis: usize| {
        let sum: Vector2<f64> =
            members.iter().map(|m| pieces[*m].pitch_m()[axis] * pieces[*m].cells.len() as f64).sum();
        let weight: usize = members.iter().map(|m| pieces[*m].cells.len()).sum();
        sum / weight as f64
    };
    let holes = rows * cols - modules.len() as i32;
    let joint = if margin.is_finite() { 1.0 - (-margin).exp() } else { 0.9 };
    let bench = FusedBench {
        rows,
        cols,
        modules,
        open_ended,
        confidence: (joint * (1.0 - 0.5 * f64::from(holes) / f64::from(rows * cols))).clamp(0.0, 1.0),
        middle_m,
        pitch_m: [mean_pitch(0), mean_pitch(1)],
        cluster,
    };
    doubts.extend(holes_to_check(views, &bench));
    let kept = accepted.iter().filter(|(_, v)| v.observed <= v.absent.len() || v.unseen.len() > 1);
    let left_out = outvoted.iter().filter(|(_, v)| v.observed > 1 || v.unseen.len() >= params.many_views);
    let name = |(row, col): &(i32, i32)| (row - low_row + 1, col - low_col + 1);
    let contested: Vec<Contested<'_>> = kept
        .map(|(place, votes)| Contested { place: name(place), kept: true, votes })
        .chain(left_out.map(|(place, votes)| Contested { place: name(place), kept: false, votes }))
        .collect();
    doubts.extend(places_to_check(views, &bench, &contested));
    Some(bench)
}

/// What all views say of all places of a bench.
fn votes(views: &[View<'_>], pieces: &[LocatedPiece], clusters: &Clusters, members: &[usize]) -> Places {
    let mut votes = Places::new();
    for &member in members {
        let (piece, place) = (&pieces[member], clusters.placements[member]);
        for cell in &piece.cells {
            let entry = votes.entry((cell.row + place.row, cell.col + place.col)).or_default();
            match cell.detection {
                Some(detection) => entry.observations.push(Observation {
                    view: piece.view,
                    detection,
                    position_m: cell.position_m,
                    cloud_m: cell.cloud_m,
                }),
                None => {
                    entry.inferred.insert(piece.view);
                }
            }
        }
    }
    let places: Vec<(i32, i32)> = votes.keys().copied().collect();
    let extents = Extent::of_views(pieces, clusters, members);
    for extent in &extents {
        for &(row, col) in &places {
            if extent.ends_before(row, col) && extent.shows(&views[extent.view], pieces, clusters, row, col) {
                votes.entry((row, col)).or_default().absent.insert(extent.view);
            }
        }
    }
    for ((row, col), entry) in &mut votes {
        // A view that shows the place in another of its pieces does not miss it.
        for observation in &entry.observations {
            entry.absent.remove(&observation.view);
            entry.inferred.remove(&observation.view);
        }
        entry.observed = entry.observations.len();
        if let [alone] = entry.observations[..] {
            let others =
                extents.iter().filter(|extent| extent.view != alone.view && !entry.inferred.contains(&extent.view));
            let looking = others.filter(|extent| extent.shows(&views[extent.view], pieces, clusters, *row, *col));
            entry.unseen = looking.map(|extent| extent.view).collect();
        }
    }
    votes
}

/// What one view shows of a bench: all its pieces together, for a bench may come in parts where modules were missed.
struct Extent {
    view: usize,
    members: Vec<usize>,
    /// First and last column and row in the bench's coordinates.
    cols: (i32, i32),
    rows: (i32, i32),
    /// Whether it is seen to end there: west, east, north, south.
    closed: [bool; 4],
}

impl Extent {
    fn of_views(pieces: &[LocatedPiece], clusters: &Clusters, members: &[usize]) -> Vec<Self> {
        let mut by_view: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for &member in members {
            by_view.entry(pieces[member].view).or_default().push(member);
        }
        by_view.into_iter().map(|(view, members)| Self::new(view, members, pieces, clusters)).collect()
    }

    fn new(view: usize, members: Vec<usize>, pieces: &[LocatedPiece], clusters: &Clusters) -> Self {
        let mut extent =
            Self { view, members, cols: (i32::MAX, i32::MIN), rows: (i32::MAX, i32::MIN), closed: [true; 4] };
        let Self { members, cols, rows, closed, .. } = &mut extent;
        for &member in members.iter() {
            let (piece, place) = (&pieces[member], clusters.placements[member]);
            let (col, row) = (place.col, place.row);
            let mut side = |side: usize, farther: bool, same: bool, end: End| {
                if farther {
                    closed[side] = end == End::Closed;
                } else if same {
                    closed[side] &= end == End::Closed;
                }
            };
            let (last_col, last_row) = (col + piece.cols - 1, row + piece.rows - 1);
            side(0, col < cols.0, col == cols.0, piece.west);
            side(1, last_col > cols.1, last_col == cols.1, piece.east);
            side(2, row < rows.0, row == rows.0, piece.north);
            side(3, last_row > rows.1, last_row == rows.1, piece.south);
            *cols = (cols.0.min(col), cols.1.max(last_col));
            *rows = (rows.0.min(row), rows.1.max(last_row));
        }
        extent
    }

    /// Whether a place lies past an end that the view sees.
    fn ends_before(&self, row: i32, col: i32) -> bool {
        (col < self.cols.0 && self.closed[0])
            || (col > self.cols.1 && self.closed[1])
            || (row < self.rows.0 && self.closed[2])
            || (row > self.rows.1 && self.closed[3])
    }

    /// Whether a place lies inside the image.
    fn shows(&self, view: &View<'_>, pieces: &[LocatedPiece], clusters: &Clusters, row: i32, col: i32) -> bool {
        let own = |member: usize| {
            let place = clusters.placements[member];
            (row - place.row, col - place.col)
        };
        let distance = |member: usize| {
            let ((r, c), piece) = (own(member), &pieces[member]);
            (-c).max(c - piece.cols + 1).max(0) + (-r).max(r - piece.rows + 1).max(0)
        };
        let Some(&member) = self.members.iter().min_by_key(|member| distance(**member)) else { return false };
        // Next to a piece's end it does: otherwise the end would be cut, and not closed.
        if distance(member) <= 1 && self.ends_before(row, col) {
            return true;
        }
        let (piece, (r, c)) = (&pieces[member], own(member));
        let off = |cell: &&LocatedCell| (cell.col - c).abs() + (cell.row - r).abs();
        let Some(nearest) = piece.cells.iter().min_by_key(off) else { return false };
        let pitch_m = piece.pitch_m();
        let step = pitch_m[0] * f64::from(c - nearest.col) + pitch_m[1] * f64::from(r - nearest.row);
        let place = nearest.position_m + Vector3::new(step.x, step.y, 0.0);
        let camera = &view.shot.camera;
        let Some(pixel) = camera.project(&view.shot.pose.to_camera(&place)) else { return false };
        // As far from the frame's edge as a module is long.
        let margin_px = piece
            .cells
            .iter()
            .find_map(|cell| Some(view.detections.detections[cell.detection?].quad.sides()))
            .map_or(0.0, |[u, v]| u.norm().max(v.norm()));
        let inside = |at: f64, size: u32| at > margin_px && at < f64::from(size) - margin_px;
        inside(pixel.x, camera.width_px) && inside(pixel.y, camera.height_px)
    }
}

/// Takes out benches that stand on top of another one: the same bench once more, which the evidence could not join. The
/// one with fewer observations goes, and it is told.
pub(super) fn without_ghosts(
    views: &[View<'_>],
    benches: Vec<FusedBench>,
    doubts: &mut Vec<OpenDoubt>,
) -> Vec<FusedBench> {
    let position = |module: &FusedModule| {
        let count = module.observations.len() as f64;
        module.observations.iter().map(|o| o.position_m.xy()).sum::<Vector2<f64>>() / count
    };
    let weight = |bench: &FusedBench| bench.modules.iter().map(|m| m.observations.len()).sum::<usize>();
    let view_count = |bench: &FusedBench| {
        bench.modules.iter().flat_map(|m| m.observations.iter().map(|o| o.view)).collect::<BTreeSet<_>>().len()
    };
    let mut order: Vec<usize> = (0..benches.len()).collect();
    order.sort_by_key(|k| (std::cmp::Reverse(weight(&benches[*k])), *k));
    let tree = RTree::bulk_load(
        benches
            .iter()
            .enumerate()
            .flat_map(|(index, bench)| {
                bench.modules.iter().map(move |m| {
                    let at = position(m);
                    GeomWithData::new([at.x, at.y], index)
                })
            })
            .collect(),
    );
    let mut kept = vec![false; benches.len()];
    let mut left_out = Vec::new();
    for &index in &order {
        let bench = &benches[index];
        let [u, v] = bench.pitch_m.map(|pitch| pitch.norm());
        let across = if bench.rows > 1 { v } else { u };
        // What one or two views alone saw may be displaced by as much as their poses err.
        let weak = view_count(bench) <= 2;
        let reach = if weak { (0.75 * u.max(across)).max(0.6 * u.min(across)).min(1.3) } else { 0.6 * u.min(across) };
        let mut covered = 0;
        let mut over = None;
        for module in &bench.modules {
            let at = position(module);
            let other = tree
                .locate_within_distance([at.x, at.y], reach * reach)
                .filter(|near| near.data != index && kept[near.data])
                .filter(|near| !weak || view_count(&benches[near.data]) >= view_count(bench))
                .map(|near| near.data)
                .min();
            if other.is_some() {
                covered += 1;
                over = other;
            }
        }
        // A real one would have been seen, and joined, by the others that look there.
        let seen_in = view_count(bench);
        let missed_in = if weak { views_missing(views, bench) } else { 0 };
        kept[index] = if missed_in >= 2 * seen_in {
            false
        } else if weak {
            2 * covered < bench.modules.len()
        } else {
            3 * covered <= bench.modules.len()
        };
        if !kept[index] {
            left_out.push(seen_apart(views, bench, over.map(|k| &benches[k])));
        }
    }
    // What was said of places inside of benches that are left out says nothing of the model.
    let ghosts: BTreeSet<usize> =
        benches.iter().zip(&kept).filter(|(_, keep)| !**keep).map(|(b, _)| b.cluster).collect();
    doubts.retain(|said| !matches!(said.clusters[..], [cluster] if ghosts.contains(&cluster)));
    doubts.extend(left_out);
    benches.into_iter().zip(kept).filter_map(|(bench, keep)| keep.then_some(bench)).collect()
}

/// A bench that is left out, and the one over which it lies.
fn seen_apart(views: &[View<'_>], bench: &FusedBench, over: Option<&FusedBench>) -> OpenDoubt {
    let names: BTreeSet<String> = bench.sightings().map(|(view, _)| views[view].shot.name.clone()).collect();
    let at = over.map_or(bench.middle_m, |other| other.middle_m);
    let doubt = Doubt {
        code: "bench_seen_apart".into(),
        message: format!(
            "{} modules seen at {:.1} m east, {:.1} m north lie over the bench at {:.1} m east, {:.1} m north, but do not fit \
             its lattice; they are left out: check these images",
            bench.modules.len(),
            bench.middle_m.x,
            bench.middle_m.y,
            at.x,
            at.y
        ),
        images: names.into_iter().collect(),
        benches: Vec::new(),
        sightings: bench.sightings().collect(),
        places_m: vec![bench.middle_m.xy()],
    };
    let clusters = std::iter::once(bench.cluster).chain(over.map(|other| other.cluster)).collect();
    OpenDoubt { doubt, clusters }
}

/// How many views show the place of a bench, wholly in their frame, and have no part in it.
fn views_missing(views: &[View<'_>], bench: &FusedBench) -> usize {
    let own: BTreeSet<usize> = bench.modules.iter().flat_map(|m| m.observations.iter().map(|o| o.view)).collect();
    let places: Vec<Vector3<f64>> = bench
        .modules
        .iter()
        .map(|m| m.observations.iter().map(|o| o.position_m).sum::<Vector3<f64>>() / m.observations.len() as f64)
        .collect();
    // Views may be displaced by as much as poses err, and what stands at the edge is cut.
    let margin_m = 2.0 + bench.pitch_m[0].norm().max(bench.pitch_m[1].norm());
    (0..views.len())
        .filter(|view| !own.contains(view) && !views[*view].layout.partial)
        .filter(|&view| {
            let (camera, pose) = (&views[view].shot.camera, &views[view].shot.pose);
            let inside = |place: &Vector3<f64>| {
                let in_camera = pose.to_camera(place);
                let margin_px = margin_m * camera.focal_px() / in_camera.z;
                camera.project(&in_camera).is_some_and(|pixel| {
                    pixel.x > margin_px
                        && pixel.y > margin_px
                        && pixel.x < f64::from(camera.width_px) - margin_px
                        && pixel.y < f64::from(camera.height_px) - margin_px
                })
            };
            inside(&bench.middle_m) && 4 * places.iter().filter(|place| inside(place)).count() > 3 * places.len()
        })
        .count()
}

/// A place at which some views see a module and others do not.
struct Contested<'a> {
    /// Row and number, from 1.
    place: (i32, i32),
    kept: bool,
    votes: &'a Votes,
}

/// Places where as many views look past the bench's end as saw a module, or more than one view looks and one alone saw a
/// module, or where more than one saw a module and yet was outvoted.
fn places_to_check(views: &[View<'_>], bench: &FusedBench, contested: &[Contested<'_>]) -> Option<OpenDoubt> {
    let first = contested.first()?;
    let shown: Vec<String> = contested
        .iter()
        .take(6)
        .map(|Contested { place: (row, number), kept, votes }| {
            let (seen, not) = (votes.observed, votes.absent.len().max(votes.unseen.len()));
            let outcome = if *kept { "kept" } else { "left out" };
            format!("row {row} number {number} is seen in {seen} and not in {not} images: {outcome}")
        })
        .collect();
    let more = if contested.len() > 6 { format!("; and {} more places", contested.len() - 6) } else { String::new() };
    let doubt = Doubt {
        code: "modules_unsure".into(),
        message: format!(
            "images disagree on the bench at {:.1} m east, {:.1} m north: {}{more}",
            bench.middle_m.x,
            bench.middle_m.y,
            shown.join("; ")
        ),
        images: first
            .votes
            .absent
            .iter()
            .chain(&first.votes.unseen)
            .map(|view| views[*view].shot.name.clone())
            .collect(),
        benches: Vec::new(),
        sightings: Vec::new(),
        places_m: vec![bench.middle_m.xy()],
    };
    Some(OpenDoubt { doubt, clusters: vec![bench.cluster] })
}

/// Places inside the bench where no view detected a module: said, not filled.
fn holes_to_check(views: &[View<'_>], bench: &FusedBench) -> Option<OpenDoubt> {
    let present: BTreeSet<(i32, i32)> = bench.modules.iter().map(|m| (m.row, m.col)).collect();
    let missing: Vec<String> = (0..bench.rows)
        .flat_map(|row| (0..bench.cols).map(move |col| (row, col)))
        .filter(|place| !present.contains(place))
        .map(|(row, col)| format!("row {} number {}", row + 1, col + 1))
        .collect();
    if missing.is_empty() {
        return None;
    }
    let images: BTreeSet<&str> =
        bench.modules.iter().flat_map(|m| m.observations.iter().map(|o| views[o.view].shot.name.as_str())).collect();
    let shown = missing.iter().take(6).cloned().collect::<Vec<_>>().join(", ");
    let more = if missing.len() > 6 { format!(" and {} more", missing.len() - 6) } else { String::new() };
    let doubt = Doubt {
        code: "modules_not_seen".into(),
        message: format!(
            "the bench at {:.1} m east, {:.1} m north has {} places where no image shows a module ({shown}{more}): they \
             are missing, or under glare in every image",
            bench.middle_m.x,
            bench.middle_m.y,
            missing.len(),
        ),
        images: images.into_iter().map(str::to_owned).collect(),
        benches: Vec::new(),
        sightings: Vec::new(),
        places_m: vec![bench.middle_m.xy()],
    };
    Some(OpenDoubt { doubt, clusters: vec![bench.cluster] })
}
