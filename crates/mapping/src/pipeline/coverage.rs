//! What no fine photo shows is looked for in the finest of the coarser ones.
//!
//! A frame may end where a bench does not, and no other photo need show what follows: a photo may be missing from the
//! reconstruction, or the flight may have been planned too narrowly. Photos from higher up, taken for the reconstruction, then
//! show these modules alone. They are searched for what is missing, and nothing else is taken from them: their boxes are worse.

use super::images::Seen;
use crate::geometry::PointCloud;
use crate::layout::{Cell, Piece};
use crate::reconstruction::Shot;
use nalgebra::{Vector2, Vector3};
use rstar::RTree;
use rstar::primitives::GeomWithData;
use std::collections::BTreeSet;

/// When and how coarser photos are searched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct CoverageParams {
    /// Least width of a module, pixels, at which a photo is worth searching: below it the networks find little.
    pub(super) least_module_px: f64,
    /// Detected modules that a piece needs for its end to count: fewer may be false boxes.
    pub(super) least_detected: usize,
    /// Coarser photos by which a place is to be shown, so that it can be triangulated.
    pub(super) photos_per_place: usize,
    /// Photos up to this much coarser than the finest that would do count as equally fine, as a factor.
    pub(super) alike_gsd: f64,
    /// Photos that are to show a module by themselves: pieces of coarser ones are kept where fewer do.
    pub(super) enough_photos: usize,
    /// Points of the cloud by which the depth at a pixel is known, at most.
    pub(super) most_points: usize,
    /// Most times that photos are added: what they show may end in their frames, too.
    pub(super) most_rounds: usize,
}

impl Default for CoverageParams {
    fn default() -> Self {
        Self {
            least_module_px: 10.0,
            least_detected: 6,
            photos_per_place: 2,
            alike_gsd: 1.2,
            enough_photos: 2,
            most_points: 4000,
            most_rounds: 3,
        }
    }
}

/// The shots of a project, and what is known of the ground that they show.
pub(super) struct Coverage<'a> {
    shots: &'a [Shot],
    gsd_m: &'a [Option<f64>],
    points_m: Vec<Vector3<f64>>,
    params: CoverageParams,
}

/// Depth of a point, metres, at its place in an image.
type Depth = GeomWithData<[f64; 2], f64>;

/// Where a module stands or would stand.
#[derive(Debug, Clone, Copy)]
struct Place {
    at_m: Vector3<f64>,
    /// The longer side of a module, metres.
    length_m: f64,
}

impl<'a> Coverage<'a> {
    pub(super) fn new(shots: &'a [Shot], gsd_m: &'a [Option<f64>], cloud: &PointCloud, params: CoverageParams) -> Self {
        let stride = cloud.positions_m.len().div_ceil(params.most_points).max(1);
        let points = cloud.positions_m.iter().step_by(stride);
        Self { shots, gsd_m, points_m: points.map(|p| Vector3::from(p.map(f64::from))).collect(), params }
    }

    pub(super) fn params(&self) -> &CoverageParams {
        &self.params
    }

    /// The coarser photos to be searched next: those that show what follows where frames of the searched ones cut a bench.
    pub(super) fn missing(&self, seen: &[Seen]) -> Vec<usize> {
        let searched: BTreeSet<usize> = seen.iter().map(|image| image.shot).collect();
        let Some(width_m) = self.module_width_m(seen) else { return Vec::new() };
        let resolves = |gsd_m: f64| width_m / gsd_m >= self.params.least_module_px;
        let candidates: Vec<(usize, f64)> = (0..self.shots.len())
            .filter(|shot| !searched.contains(shot))
            .filter_map(|shot| Some((shot, self.gsd_m[shot].filter(|gsd| resolves(*gsd))?)))
            .collect();
        if candidates.is_empty() {
            return Vec::new();
        }
        let mut lacking: Vec<(Vec<usize>, usize)> = self
            .ends(seen)
            .into_iter()
            .filter(|place| !searched.iter().any(|shot| self.shows(*shot, place)))
            .map(|place| {
                let shown = candidates.iter().filter(|(shot, _)| self.shows(*shot, &place));
                (shown.map(|(shot, _)| *shot).collect(), self.params.photos_per_place)
            })
            .collect();
        let mut chosen = BTreeSet::new();
        while let Some(shot) = self.most_useful(&candidates, &lacking, &chosen) {
            chosen.insert(shot);
            for (shown, needed) in &mut lacking {
                *needed -= usize::from(*needed > 0 && shown.contains(&shot));
            }
        }
        chosen.into_iter().collect()
    }

    /// Of the photos about as fine as the finest that show something lacking the one that shows most of it.
    fn most_useful(
        &self,
        candidates: &[(usize, f64)],
        lacking: &[(Vec<usize>, usize)],
        chosen: &BTreeSet<usize>,
    ) -> Option<usize> {
        let useful: Vec<(usize, f64, usize)> = candidates
            .iter()
            .filter(|(shot, _)| !chosen.contains(shot))
            .map(|&(shot, gsd_m)| {
                let places = lacking.iter().filter(|(shown, needed)| *needed > 0 && shown.contains(&shot));
                (shot, gsd_m, places.count())
            })
            .filter(|(_, _, places)| *places > 0)
            .collect();
        let finest = useful.iter().map(|(_, gsd_m, _)| *gsd_m).fold(f64::INFINITY, f64::min);
        let fine = useful.into_iter().filter(|(_, gsd_m, _)| *gsd_m <= finest * self.params.alike_gsd);
        fine.max_by_key(|(shot, _, places)| (*places, std::cmp::Reverse(*shot))).map(|(shot, _, _)| shot)
    }

    /// Keeps of a coarser photo the pieces that show modules which too few of the `fine` shots do.
    pub(super) fn keep_lacking(&self, image: &mut Seen, fine: &BTreeSet<usize>) {
        let shot = image.shot;
        let depths = self.depths(shot);
        let is_lacking = |piece: &Piece| {
            piece.detected().any(|(cell, _)| {
                let place = self.place(shot, &depths, cell.quad.center(), self.length_m(shot, cell));
                place.is_some_and(|place| {
                    fine.iter().filter(|other| self.shows(**other, &place)).count() < self.params.enough_photos
                })
            })
        };
        let kept: Vec<bool> = image.layout.pieces.iter().map(is_lacking).collect();
        image.layout.keep_pieces(&kept);
    }

    /// The places next to modules that their own photo's frame cuts off.
    fn ends(&self, seen: &[Seen]) -> Vec<Place> {
        let mut places = Vec::new();
        for image in seen {
            let camera = &self.shots[image.shot].camera;
            let depths = self.depths(image.shot);
            let size = Vector2::new(f64::from(camera.width_px), f64::from(camera.height_px));
            let is_cut = |corner: &Vector2<f64>| {
                corner.x < 0.0 || corner.y < 0.0 || corner.x > size.x - 1.0 || corner.y > size.y - 1.0
            };
            for piece in &image.layout.pieces {
                if piece.detected().count() < self.params.least_detected {
                    continue;
                }
                for (cell, _) in piece.detected() {
                    for (row, col) in [(0, 1), (0, -1), (1, 0), (-1, 0)] {
                        if piece.cell(cell.row + row, cell.col + col).is_some() {
                            continue;
                        }
                        let at = |r: i32, c: i32| piece.map.pixel(f64::from(c), f64::from(r));
                        let step = at(cell.row + row, cell.col + col) - at(cell.row, cell.col);
                        let next = cell.quad.map(|corner| corner + step);
                        if next.corners.iter().any(is_cut) {
                            places.extend(self.place(
                                image.shot,
                                &depths,
                                next.center(),
                                self.length_m(image.shot, cell),
                            ));
                        }
                    }
                }
            }
        }
        places
    }

    /// The shorter side of a typical module, metres.
    fn module_width_m(&self, seen: &[Seen]) -> Option<f64> {
        let mut widths: Vec<f64> = seen
            .iter()
            .filter_map(|image| Some((image, self.gsd_m[image.shot]?)))
            .flat_map(|(image, gsd_m)| {
                let cells = image.layout.pieces.iter().flat_map(Piece::detected);
                cells.map(move |(cell, _)| cell.quad.extent_px().0.min(cell.quad.extent_px().1) * gsd_m)
            })
            .collect();
        let middle = widths.len() / 2;
        (!widths.is_empty()).then(|| *widths.select_nth_unstable_by(middle, f64::total_cmp).1)
    }

    fn length_m(&self, shot: usize, cell: &Cell) -> f64 {
        let (one, other) = cell.quad.extent_px();
        one.max(other) * self.gsd_m[shot].unwrap_or(0.0)
    }

    /// The points of the cloud in an image, with their depths.
    fn depths(&self, shot: usize) -> RTree<Depth> {
        let Shot { camera, pose, .. } = &self.shots[shot];
        let points = self.points_m.iter().filter_map(|point| {
            let in_camera = pose.to_camera(point);
            Some(GeomWithData::new(camera.project(&in_camera)?.into(), in_camera.z))
        });
        RTree::bulk_load(points.collect())
    }

    /// Where a pixel's ray meets the ground, as deep as the nearest point in the image.
    fn place(&self, shot: usize, depths: &RTree<Depth>, pixel: Vector2<f64>, length_m: f64) -> Option<Place> {
        let Shot { camera, pose, .. } = &self.shots[shot];
        let depth_m = depths.nearest_neighbor(pixel.into())?.data;
        let seen = camera.normalised_from_pixel(pixel);
        let ray = pose.direction_to_world(&Vector3::new(seen.x, seen.y, 1.0));
        Some(Place { at_m: pose.center() + ray * depth_m, length_m })
    }

    /// Whether a photo shows a place with a module's length about it.
    fn shows(&self, shot: usize, place: &Place) -> bool {
        let Shot { camera, pose, .. } = &self.shots[shot];
        let in_camera = pose.to_camera(&place.at_m);
        let margin_px = place.length_m * camera.focal_px() / in_camera.z.max(1e-9);
        camera.project(&in_camera).is_some_and(|pixel| {
            pixel.x > margin_px
                && pixel.y > margin_px
                && pixel.x < f64::from(camera.width_px) - margin_px
                && pixel.y < f64::from(camera.height_px) - margin_px
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::{Detection, ImageDetections, Source};
    use crate::geometry::{Camera, Pose, Quad};
    use crate::layout::{self, LayoutOptions};

    const FOCAL: f64 = 0.8;

    /// Straight down from a height above a place, east to the right.
    fn shot(name: &str, east_m: f64, north_m: f64, height_m: f64) -> Shot {
        let turn = Vector3::new(std::f64::consts::PI, 0.0, 0.0);
        let mut pose = Pose::from_axis_angle(turn, Vector3::zeros());
        pose.translation_m = -(pose.camera_from_world * Vector3::new(east_m, north_m, height_m));
        Shot { name: name.to_owned(), camera: Camera::pinhole(1200, 800, FOCAL), pose, gnss_enu_m: None }
    }

    /// All modules of two rows of 30 along the east, at two places, that a shot shows wholly.
    fn seen(shots: &[Shot], index: usize) -> Seen {
        let Shot { name, camera, pose, .. } = &shots[index];
        let mut detections = Vec::new();
        for (north_m, row, col) in [0.0, 12.0].into_iter().flat_map(|n| (0..60).map(move |k| (n, k / 30, k % 30))) {
            let center = Vector3::new(f64::from(col) * 1.02, north_m - f64::from(row) * 1.72, 0.0);
            let at =
                |east: f64, north: f64| camera.project(&pose.to_camera(&(center + Vector3::new(east, north, 0.0))));
            let corners = [at(-0.5, 0.85), at(0.5, 0.85), at(0.5, -0.85), at(-0.5, -0.85)].map(Option::unwrap);
            if corners.iter().all(|c| c.x > 2.0 && c.y > 2.0 && c.x < 1197.0 && c.y < 797.0) {
                let quad = Quad::from_unordered(corners).unwrap();
                detections.push(Detection { quad, score: 1.0, source: Source::External });
            }
        }
        let detections = ImageDetections { image: name.clone(), width_px: 1200, height_px: 800, detections };
        let layout = layout::infer(&detections, None, &LayoutOptions::default());
        Seen { shot: index, detections, layout }
    }

    fn ground() -> PointCloud {
        let points = (0..2000).map(|k| [(k % 50) as f32 * 2.0 - 30.0, (k / 50) as f32 * 2.0 - 40.0, 0.0]);
        PointCloud { positions_m: points.collect(), normals: Vec::new() }
    }

    /// Two fine photos that show the western part, one that shows the rest, two coarse ones that show all, one too coarse.
    fn flight() -> (Vec<Shot>, Vec<Option<f64>>) {
        let shots = vec![
            shot("west", 2.0, 6.0, 40.0),
            shot("west again", 3.0, 6.0, 40.0),
            shot("high", 14.0, 6.0, 75.0),
            shot("high again", 18.0, 6.0, 75.0),
            shot("too high", 14.0, 6.0, 150.0),
            shot("east", 26.0, 6.0, 40.0),
        ];
        let gsd_m = [40.0, 40.0, 75.0, 75.0, 150.0, 40.0].map(|height| Some(height / (FOCAL * 1200.0))).to_vec();
        (shots, gsd_m)
    }

    #[test]
    fn coarser_photos_are_searched_where_they_alone_show_how_a_bench_goes_on() {
        let (shots, gsd_m) = flight();
        let cloud = ground();
        let coverage = |count: usize| Coverage::new(&shots[..count], &gsd_m, &cloud, CoverageParams::default());
        let west = || [0, 1].map(|index| seen(&shots, index)).to_vec();
        assert_eq!(coverage(5).missing(&west()), [2, 3]);
        // Where another fine photo shows it nothing is missing.
        let mut all = west();
        all.push(seen(&shots, 5));
        assert_eq!(coverage(6).missing(&all), [] as [usize; 0]);
        // What the coarser ones show ends in no frame.
        let mut more = west();
        more.extend([2, 3].map(|index| seen(&shots, index)));
        assert_eq!(coverage(5).missing(&more), [] as [usize; 0]);
    }

    #[test]
    fn a_coarser_photo_keeps_what_it_shows_alone() {
        let (shots, gsd_m) = flight();
        let cloud = ground();
        let coverage = Coverage::new(&shots, &gsd_m, &cloud, CoverageParams::default());
        let kept = |fine: &[usize]| {
            let mut image = seen(&shots, 2);
            assert_eq!(image.layout.pieces.len(), 2);
            coverage.keep_lacking(&mut image, &fine.iter().copied().collect());
            assert!(image.layout.partial);
            image.layout.pieces.len()
        };
        assert_eq!(kept(&[0, 1]), 2);
        assert_eq!(kept(&[0, 1, 4, 5, 2]), 0);
    }
}
